"""Training of YOLOv8n-seg on a CPU: ultralytics' trainer, with the network in bfloat16 and the loss in float32."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from models.detector.weights import ARCHITECTURE, disable_ultralytics_network, new_network

disable_ultralytics_network()  # ultralytics reads the variables when it is imported

import torch  # noqa: E402
import ultralytics.utils  # noqa: E402
from torch import distributed  # noqa: E402
from ultralytics.models.yolo.segment import SegmentationTrainer  # noqa: E402
from ultralytics.nn.tasks import SegmentationModel  # noqa: E402


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingPhase:
    """Training run at one picture size; each phase starts from the weights of the one before."""

    imgsz: int
    """Longer side of the pictures [px]."""
    epochs: int
    lr0: float
    """Learning rate after the warm-up."""
    lrf: float
    """Ratio of the final rate to `lr0`; linear in between, in steps of one batch."""
    warmup_epochs: float
    batch: int = 16
    fraction: int | float = 12_000
    """Number of pictures, the first of the data set, or their fraction of it."""


TRAINING_PHASES = (
    TrainingPhase(imgsz=192, epochs=12, lr0=2.0e-3, lrf=0.8, warmup_epochs=1.0),
    TrainingPhase(imgsz=256, epochs=9, lr0=1.6e-3, lrf=0.75, warmup_epochs=0.2),
    TrainingPhase(imgsz=320, epochs=11, lr0=1.2e-3, lrf=0.02, warmup_epochs=0.2),
    TrainingPhase(imgsz=320, epochs=2, lr0=6.0e-4, lrf=0.02, warmup_epochs=0.1, fraction=1.0),
)
"""Small pictures give most of the accuracy at a fraction of the time; the last have the size of the network's use. The
learning rate falls throughout, and once more over the last passes, which have more pictures."""

AUGMENTATION = {
    "hsv_h": 0.03,
    "hsv_s": 0.5,
    "hsv_v": 0.3,
    "degrees": 3.0,
    "translate": 0.05,
    "scale": 0.2,
    "fliplr": 0.5,
    "mosaic": 0.0,
}
"""In addition to the scenes' own variety. No mosaic: the camera never shows four scenes at a quarter of the size."""

GAINS = {"cls": 1.0}
"""Gains of the loss other than ultralytics': outlines are good early, the class is learnt last."""


class Bf16SegmentationModel(SegmentationModel):
    """Segmentation network in bfloat16 (twice as fast with AVX-512 BF16), with its loss in float32."""

    def loss(self, batch, preds=None):
        """Return ultralytics' loss and its parts."""
        if preds is None:
            with torch.autocast("cpu", torch.bfloat16):
                preds = self.forward(batch["img"])
        return super().loss(batch, _to_float(preds))


class CpuSegmentationTrainer(SegmentationTrainer):
    """Ultralytics' trainer without validation between epochs, for a network in bfloat16 and channels-last."""

    def get_model(self, cfg=None, weights=None, verbose=True):
        """Return the network, with `weights` if given."""
        model = Bf16SegmentationModel(
            cfg or f"{ARCHITECTURE}.yaml",  # pyright: ignore[reportArgumentType] - a checkpoint's is a dict
            nc=self.data["nc"],
            ch=self.data["channels"],
            verbose=False,
        )
        model = self.set_model_names_for_load(model)
        if weights:
            model.load(weights)
        return model.to(memory_format=torch.channels_last)

    def preprocess_batch(self, batch: dict) -> dict:
        """Return the batch with its pictures in channels-last."""
        batch = super().preprocess_batch(batch)
        batch["img"] = batch["img"].contiguous(memory_format=torch.channels_last)
        return batch

    def _setup_train(self) -> None:
        """Prepare the training, then copy the first process's weights to all."""
        super()._setup_train()
        if distributed.is_initialized():
            for value in self.model.state_dict().values():
                distributed.broadcast(value, 0)

    def optimizer_step(self) -> None:
        """Step with the mean gradient of all processes and the learning rate of this batch.

        Ultralytics' own rate falls once an epoch, and its own processes need a GPU each.
        """
        if distributed.is_initialized():
            self._average_gradients()
        super().optimizer_step()
        batches = len(self.train_loader)
        self.steps = getattr(self, "steps", self.start_epoch * batches) + 1
        if self.steps > self._get_warmup_iterations(batches):
            assert self.optimizer is not None and self.lf is not None
            for group in self.optimizer.param_groups:
                group["lr"] = group["initial_lr"] * self.lf(self.steps / batches)

    def _average_gradients(self) -> None:
        gradients = [p.grad for p in self.model.parameters() if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients]) / distributed.get_world_size()
        distributed.all_reduce(flat)
        for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(mean.view_as(gradient))

    def validate(self):
        """Skip the validation: held-out pictures are used after the training only."""
        return {}, float(self.epoch)

    def final_eval(self) -> None:
        """Skip the evaluation for the same reason; the checkpoint is unchanged."""


def train_phase(phase: TrainingPhase, *, data: Path, folder: Path, start: Path | None, seed: int, threads: int) -> Path:
    """Train one phase, or the rest of it, and return its last checkpoint.

    With a process group of torch.distributed (RANK, LOCAL_RANK and WORLD_SIZE set before ultralytics is imported),
    its processes share each batch.

    Args:
        phase: size, epochs and rates.
        data: ultralytics' description of the data set (`data.yaml`).
        folder: of this phase; a checkpoint in it is resumed.
        start: checkpoint of the phase before; None = from scratch.
        seed: of weights, order and augmentation.
        threads: of torch.
    """
    last = folder / "weights" / "last.pt"
    if (folder / "done").exists():
        return last
    settings = asdict(phase) | AUGMENTATION | GAINS
    settings |= {"model": f"{ARCHITECTURE}.yaml", "data": str(data), "pretrained": str(start) if start else False}
    settings |= {"project": str(folder.parent), "name": folder.name, "exist_ok": True, "device": "cpu", "seed": seed}
    settings |= {"optimizer": "AdamW", "weight_decay": 0.005, "nbs": phase.batch, "momentum": 0.9, "workers": 0}
    settings |= {"rect": True, "amp": False, "val": False, "plots": False, "patience": 0, "close_mosaic": 0}
    settings |= {"warmup_bias_lr": 0.0, "deterministic": True, "resume": str(last) if last.exists() else False}
    settings["batch"] = phase.batch // (distributed.get_world_size() if distributed.is_initialized() else 1)
    settings["cache"] = "ram"  # the pictures at the phase's size: 0.7 to 3 GB
    if distributed.is_initialized() and distributed.get_rank() != ultralytics.utils.RANK:
        raise RuntimeError("ultralytics does not know the other processes, so each would process all pictures.")
    trainer = CpuSegmentationTrainer(overrides=settings)
    trainer.add_callback("on_train_start", lambda _: torch.set_num_threads(threads))
    trainer.world_size = 1 if distributed.is_initialized() else 0  # gradients are averaged here, not summed there
    trainer.train()
    if distributed.is_initialized():
        distributed.barrier()  # the others resume from the checkpoint that the first writes
    # After the last checkpoint: a phase without this file is resumed
    (folder / "done").touch()
    return last


def read_checkpoint(path: Path) -> torch.nn.Module:
    """Return the averaged weights of a checkpoint of `train_phase` in a plain float32 network."""
    # A pickle, but one that this training has written
    saved = torch.load(path, map_location="cpu", weights_only=False)["ema"].float()
    model = new_network(len(saved.names))
    model.load_state_dict(saved.state_dict())
    return model


def _to_float(value):
    if isinstance(value, torch.Tensor):
        return value.float()
    if isinstance(value, dict):
        return {key: _to_float(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_to_float(item) for item in value)
    return value

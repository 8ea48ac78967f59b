"""YOLOv8n-seg trained on a CPU: ultralytics' trainer, with the network in bfloat16 and the loss in float32."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("YOLO_OFFLINE", "True")  # read by ultralytics when it is loaded: nothing is fetched or reported
os.environ.setdefault("YOLO_AUTOINSTALL", "False")

import torch  # noqa: E402
from ultralytics.models.yolo.segment import SegmentationTrainer  # noqa: E402
from ultralytics.nn.tasks import SegmentationModel  # noqa: E402

ARCHITECTURE = "yolov8n-seg.yaml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """One run at one picture size; each phase starts from the weights of the one before."""

    imgsz: int
    """Longer side of the pictures [px]."""
    epochs: int
    lr0: float
    """Learning rate after the warm-up."""
    lrf: float
    """Share of `lr0` at the end; a straight line between."""
    warmup_epochs: float
    batch: int = 16


PHASES = (
    Phase(imgsz=320, epochs=10, lr0=1.5e-3, lrf=0.35, warmup_epochs=0.7),
    Phase(imgsz=416, epochs=6, lr0=6e-4, lrf=0.5, warmup_epochs=0.1),
    Phase(imgsz=640, epochs=3, lr0=3e-4, lrf=0.03, warmup_epochs=0.1),
)
"""Small pictures teach most of it at a fifth of the time; the last phase has the size at which the network is used."""

AUGMENTATION = {
    "hsv_h": 0.03,
    "hsv_s": 0.5,
    "hsv_v": 0.3,
    "degrees": 5.0,
    "translate": 0.08,
    "scale": 0.35,
    "perspective": 0.0002,
    "fliplr": 0.5,
    "mosaic": 0.0,
}
"""On top of what the scenes vary themselves. No mosaic: four scenes of a quarter's size are not what the arm sees."""


class Bf16SegmentationModel(SegmentationModel):
    """The network runs in bfloat16 (twice as fast where the processor has AVX-512 BF16), its loss in float32."""

    def loss(self, batch, preds=None):  # noqa: ANN001, ANN201 - ultralytics' signature
        """Return ultralytics' loss and its parts."""
        if preds is None:
            with torch.autocast("cpu", torch.bfloat16):
                preds = self.forward(batch["img"])
        return super().loss(batch, _to_float(preds))


class CpuSegmentationTrainer(SegmentationTrainer):
    """Ultralytics' trainer without validation between epochs, for a network in bfloat16 and channels-last."""

    def get_model(self, cfg=None, weights=None, verbose=True):  # noqa: ANN001, ANN201
        """Return the network, with `weights` if given."""
        model = Bf16SegmentationModel(cfg, nc=self.data["nc"], ch=self.data["channels"], verbose=False)
        model = self.set_model_names_for_load(model)
        if weights:
            model.load(weights)
        return model.to(memory_format=torch.channels_last)

    def preprocess_batch(self, batch: dict) -> dict:
        """Return the batch with its pictures in channels-last."""
        batch = super().preprocess_batch(batch)
        batch["img"] = batch["img"].contiguous(memory_format=torch.channels_last)
        return batch

    def validate(self):  # noqa: ANN201
        """Skip: held-out pictures are for the measurement after the training alone."""
        return {}, float(self.epoch)

    def final_eval(self) -> None:
        """Skip, for the same reason; the checkpoint stays as it is."""


def train_phase(phase: Phase, data: Path, folder: Path, start: Path | None, seed: int, threads: int) -> Path:
    """Train one phase, or what is left of it, and return its last checkpoint.

    Args:
        phase: what to do.
        data: ultralytics' description of the data set (`data.yaml`).
        folder: of this phase; a checkpoint in it is taken up where it stopped.
        start: checkpoint of the phase before; None = from scratch.
        seed: of weights, order and augmentation.
        threads: of torch.
    """
    last = folder / "weights" / "last.pt"
    if (folder / "done").exists():
        return last
    settings = asdict(phase) | AUGMENTATION
    settings |= {"model": ARCHITECTURE, "data": str(data), "seed": seed, "pretrained": str(start) if start else False}
    settings |= {"project": str(folder.parent), "name": folder.name, "exist_ok": True, "device": "cpu", "workers": 0}
    settings |= {"optimizer": "AdamW", "weight_decay": 0.005, "nbs": phase.batch, "momentum": 0.9}
    settings |= {"rect": True, "amp": False, "val": False, "plots": False, "patience": 0, "close_mosaic": 0}
    settings |= {"warmup_bias_lr": 0.0, "deterministic": True, "resume": str(last) if last.exists() else False}
    trainer = CpuSegmentationTrainer(overrides=settings)
    trainer.add_callback("on_train_start", lambda _: torch.set_num_threads(threads))
    trainer.train()
    (folder / "done").touch()
    return last


def read_checkpoint(path: Path) -> SegmentationModel:
    """Return the averaged weights of a checkpoint of ours in a plain float32 network."""
    saved = torch.load(path, map_location="cpu", weights_only=False)["ema"].float()
    model = SegmentationModel(ARCHITECTURE, nc=saved.nc, verbose=False)
    model.load_state_dict(saved.state_dict())
    model.names = saved.names
    return model.eval()


def _to_float(value):  # noqa: ANN001, ANN202 - a nest of whatever the head returns
    if isinstance(value, torch.Tensor):
        return value.float()
    if isinstance(value, dict):
        return {key: _to_float(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_to_float(item) for item in value)
    return value

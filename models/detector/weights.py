"""Weights of detectors, ours or ultralytics', as torch modules and as cached ONNX files."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hal.base.files import atomic_path
from models.weights_file import (
    WEIGHTS_FOLDER,
    WeightsError,
    read_arrays,
    sha256_of,
    single_threaded_workers,
    verify_sha256,
    write_arrays,
)

if TYPE_CHECKING:
    from torch import nn


CLASSES = ("bottle", "cylinder", "box")
"""Classes of the shipped detector, in the order of its outputs."""
ARCHITECTURE = "yolov8n-seg"
INPUT_HW = (256, 320)
"""(H, W) of its input [px]: the size at the end of its training, in multiples of the stride of 32."""
CAMERA_HW = (480, 640)
"""(H, W) of the D405's images [px], the input size of networks that have none of their own."""
TRAIN_COMMAND = "python -m scripts.train.train_detector"
"""The command that makes the weights."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoadedDetector:
    """Network and the meaning of its outputs."""

    network: nn.Module
    """SegmentationModel of ultralytics, in evaluation mode, float32, not fused."""
    names: tuple[str, ...]
    """Classes in the order of the outputs."""
    input_hw: tuple[int, int]
    """(H, W) of the images it was trained for [px]."""


def detector_path() -> Path:
    """Return the path of the shipped detector's weights."""
    return WEIGHTS_FOLDER / "detector.npz"


def save_detector(
    path: Path,
    model: nn.Module,
    names: Sequence[str] | Mapping[int, str] = CLASSES,
    input_hw: tuple[int, int] = INPUT_HW,
) -> str:
    """Write a trained YOLOv8n-seg to `path` (.npz) and its SHA-256 next to it; return the latter.

    Matrices and kernels are kept in half precision. Vectors keep theirs: the variances of the batch norms exceed the
    range of half precision, and all vectors together are one hundredth of the file.

    Args:
        path: the file, ending in .npz.
        model: ultralytics' SegmentationModel (of a `YOLO`, its `.model`), not fused.
        names: its classes in the order of the outputs, as a sequence or as ultralytics' {index: name}.
        input_hw: (H, W) of the images it was trained for, multiples of 32 [px].

    Raises:
        WeightsError: the model is not a YOLOv8n-seg with that many classes, is fused, or is not finite.
    """
    names = tuple(names[i] for i in range(len(names)))
    state = {key: value.detach().cpu().numpy() for key, value in model.state_dict().items()}
    with np.errstate(over="ignore"):  # checked next
        arrays = {f"network/{key}": _compact(value) for key, value in state.items()}
    for key, value in arrays.items():
        if not np.isfinite(value).all():
            raise WeightsError(
                f"{key} of the model is not finite in half precision; the training has diverged.",
                code="weights_not_finite",
            )
    _build_network(arrays, len(names), f"the model for {path.name}")  # a file that cannot be read is not written
    return write_arrays(
        path,
        {"architecture": np.array(ARCHITECTURE), "names": np.array(names), "input_hw": np.array(input_hw), **arrays},
    )


def load_detector(path: Path) -> LoadedDetector:
    """Return the network of the file at `path`, in evaluation mode.

    Raises:
        WeightsError: the file or its checksum is missing, they differ, or the file is of another network.
    """
    arrays = read_arrays(path, TRAIN_COMMAND)
    if lacking := [key for key in ("architecture", "names", "input_hw") if key not in arrays]:
        raise WeightsError(f"{path.name} is no detector: it lacks {', '.join(lacking)}.", code="weights_incomplete")
    if (architecture := str(arrays["architecture"])) != ARCHITECTURE:
        raise WeightsError(
            f"{path.name} holds a {architecture}; this version reads {ARCHITECTURE}.", code="weights_other_network"
        )
    names = tuple(str(name) for name in arrays["names"])
    height, width = (int(size) for size in arrays["input_hw"])
    network = _build_network(arrays, len(names), path.name)
    return LoadedDetector(network=network, names=names, input_hw=(height, width))


def new_network(n_classes: int) -> nn.Module:
    """Return an untrained YOLOv8n-seg for `n_classes`, in evaluation mode."""
    disable_ultralytics_network()
    from ultralytics.nn.tasks import SegmentationModel

    return SegmentationModel(f"{ARCHITECTURE}.yaml", ch=3, nc=n_classes, verbose=False).eval()


def disable_ultralytics_network() -> None:
    """Disable installation, network access and output of ultralytics; call it before ultralytics is imported."""
    # `setdefault`: the user's own values win
    os.environ.setdefault("YOLO_AUTOINSTALL", "false")
    os.environ.setdefault("YOLO_VERBOSE", "false")
    os.environ.setdefault("YOLO_OFFLINE", "true")


def _compact(value: np.ndarray) -> np.ndarray:
    if value.dtype.kind != "f":
        return value  # counters
    return value.astype(np.float16 if value.ndim > 1 else np.float32)


def _build_network(arrays: Mapping[str, np.ndarray], n_classes: int, name: str) -> nn.Module:
    """Return the network with its part of `arrays`; `name` is that of their source in errors."""
    import torch

    state = {
        key.removeprefix("network/"): torch.from_numpy(value.astype(np.float32) if value.dtype.kind == "f" else value)
        for key, value in arrays.items()
        if key.startswith("network/")
    }
    network = new_network(n_classes)
    try:
        network.load_state_dict(state)
    except RuntimeError as err:
        first = "; ".join(line.strip() for line in str(err).splitlines()[1:2])
        raise WeightsError(
            f"{name} is not a {ARCHITECTURE} (not fused) of {n_classes} classes: {first[:200]}",
            code="weights_other_network",
        ) from err
    return network


MODULE_SUFFIXES = (".npz", ".pt")
"""Files with a network's weights; the others hold a graph for a runtime."""
_EXPORT = "v1"
"""Version of the export: a change makes older files obsolete."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectorModule:
    """Network with its batch norms folded in."""

    network: Any
    """DetectionModel of ultralytics; gives (rows, prototypes), or rows alone without masks."""
    names: tuple[str, ...]
    """Classes in the order of the outputs."""
    input_hw: tuple[int, int]
    """(H, W) of its input [px]."""


def load_module(path: Path) -> DetectorModule:
    """Return the detector of this project's .npz or of ultralytics' .pt.

    From a .pt, which is a pickle, only ultralytics' and torch's own classes are created.

    Raises:
        WeightsError: the file is missing, damaged, or holds no supported detector.
    """
    network: Any
    if path.suffix == ".npz":
        loaded = load_detector(path)
        network, names, input_hw = loaded.network, loaded.names, loaded.input_hw
    else:
        (network, names), input_hw = _load_checkpoint(path), CAMERA_HW
    network = network.fuse(verbose=False).eval()
    for parameter in network.parameters():
        parameter.requires_grad_(False)
    head: Any = network.model[-1]
    head.export = True  # plain outputs, without those for training
    return DetectorModule(network=network, names=names, input_hw=input_hw)


def export_to_onnx(path: Path, folder: Path | None = None) -> Path:
    """Return an ONNX file of the detector at `path` (.npz, .pt), made the first time and kept in `folder`.

    The export takes some seconds, nearly all of them to load torch and ultralytics, which inference does not need.

    Args:
        path: the weights.
        folder: cache of the file; by default the user's.

    Raises:
        WeightsError: as `load_module`.
    """
    digest = verify_sha256(path, TRAIN_COMMAND) if path.suffix == ".npz" else sha256_of(path)
    target = (folder or cache_folder()) / f"{path.stem}-{digest[:16]}-{_EXPORT}.onnx"
    if not target.is_file():
        with atomic_path(target) as partial, single_threaded_workers(1, "export") as worker:
            worker.submit(lambda: _export(load_module(path), partial)).result()
    return target


def cache_folder() -> Path:
    """Return the user's cache folder, or a new temporary one where that cannot be written."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = home / "z1-grasp"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="z1-grasp-"))


def _load_checkpoint(path: Path) -> tuple[Any, tuple[str, ...]]:
    disable_ultralytics_network()
    from ultralytics.nn.tasks import torch_safe_load

    try:
        checkpoint, _ = torch_safe_load(str(path), safe_only=True)
        network: Any = checkpoint.get("ema") or checkpoint["model"]
        head = type(network.model[-1]).__name__
    except Exception as err:  # unpickling a foreign file raises errors without a common class
        reason = str(err).splitlines()[0][:120] if str(err) else type(err).__name__
        raise WeightsError(
            f"{path.name} is no checkpoint of ultralytics' YOLO ({reason}).", code="not_a_checkpoint"
        ) from err
    if head not in ("Detect", "Segment") or network.model[-1].end2end:
        raise WeightsError(
            f"{path.name} ends in a {head}; a YOLOv8 (or 11) that detects or segments is supported.",
            code="unsupported_head",
        )
    return network.float(), tuple(network.names[i] for i in range(len(network.names)))


def _export(module: DetectorModule, path: Path) -> None:
    import onnx
    import torch

    outputs = ["output0", "output1"][: 2 if hasattr(module.network.model[-1], "proto") else 1]
    image = torch.zeros(1, 3, *module.input_hw)
    with warnings.catch_warnings(), torch.no_grad():
        # The exporter through torch.export takes ten times as long and needs another package.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module.network,
            (image,),
            path,
            dynamo=False,
            opset_version=17,
            input_names=["images"],
            output_names=outputs,
        )
    model = onnx.load(path)
    # In ultralytics' format, so that one reader serves this file and a user's.
    values = {"names": str(dict(enumerate(module.names))), "task": "segment" if len(outputs) == 2 else "detect"}
    onnx.helper.set_model_props(model, values)
    onnx.save(model, path)

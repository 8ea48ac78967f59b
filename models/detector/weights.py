"""Weights of the shipped detector on disk: YOLOv8n-seg as plain arrays, with its class names and a checksum."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from models.weights_file import WEIGHTS_FOLDER, WeightsError, read_arrays, write_arrays

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

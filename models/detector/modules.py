"""Detectors as torch modules, from own weights or an ultralytics checkpoint, and their cached ONNX export."""

from __future__ import annotations

import os
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.base.files import atomic_path
from models.detector.weights import CAMERA_HW, TRAIN_COMMAND, disable_ultralytics_network, load_detector
from models.torch_threads import single_threaded_workers
from models.weights_file import WeightsError, sha256_of, verify_sha256

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

"""Detector networks in OpenVINO, ONNX Runtime or torch, with the same outputs."""

from __future__ import annotations

import ast
import os
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hal.base.errors import InvalidValueError
from models.detector.weights import CAMERA_HW, MODULE_SUFFIXES, detector_path, export_to_onnx, load_module
from models.weights_file import WeightsError, has_bfloat16, single_threaded_workers

_PACKAGES = {"openvino": ("openvino",), "onnxruntime": ("onnxruntime",), "torch": ("torch", "ultralytics")}
RUNTIMES = tuple(_PACKAGES)
"""Fastest on a CPU first, as measured on x86-64; `./z1 doctor` measures this machine."""
_THREADS = 2
"""More threads help little, and servo and camera need cores of their own."""


class DetectorNetwork(Protocol):
    """Network that is ready for inference."""

    runtime: str
    """One of `RUNTIMES`."""
    names: tuple[str, ...]
    """Classes in the order of the outputs."""
    input_hw: tuple[int, int]
    """(H, W) of its input [px]."""

    def run(self, blob: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the rows (4 + C + M, A) and the prototypes (M, h, w), or None, for an input (1, 3, H, W) float32."""
        ...


def installed_runtimes(weights: Path | None = None) -> tuple[str, ...]:
    """Return those of `RUNTIMES` that are installed and can run the file `weights` (None: the shipped one)."""
    weights = weights or detector_path()
    if weights.suffix in MODULE_SUFFIXES:
        exporting = ("onnx", "torch", "ultralytics")
        wanted = {name: packages + (exporting if name != "torch" else ()) for name, packages in _PACKAGES.items()}
    elif weights.suffix == ".onnx":
        wanted = {name: _PACKAGES[name] for name in ("openvino", "onnxruntime")}
    else:
        wanted = {"openvino": _PACKAGES["openvino"]}
    return tuple(name for name, packages in wanted.items() if all(find_spec(package) for package in packages))


def open_network(weights: Path | None = None, runtime: str = "auto") -> DetectorNetwork:
    """Return the network of a file, in the first of `RUNTIMES` that is installed, or in `runtime`.

    Args:
        weights: this project's .npz, ultralytics' .pt, .onnx, or OpenVINO's .xml or the folder that holds one; None
            takes the shipped file.
        runtime: one of `RUNTIMES`, or `auto`.

    Raises:
        WeightsError: the file is missing, damaged, or holds no supported detector.
        InvalidValueError: that runtime is unknown, not installed, or cannot run this kind of file.
    """
    path = _resolve_path(weights or detector_path())
    runnable = installed_runtimes(path)
    if runtime not in ("auto", *RUNTIMES):
        raise InvalidValueError(
            f"there is no detector runtime {runtime!r}; known: auto, {', '.join(RUNTIMES)}.", code="unknown_runtime"
        )
    if not runnable or runtime not in ("auto", *runnable):
        raise InvalidValueError(
            f"{path.name} cannot be run by {'anything here' if runtime == 'auto' else runtime}; installed for it: "
            f"{', '.join(runnable) or 'none'}. To install the others: uv sync --extra fast-detector.",
            code="runtime_unavailable",
        )
    chosen = runnable[0] if runtime == "auto" else runtime
    if chosen == "torch":
        return _check_outputs(TorchNetwork(path), path)
    graph = export_to_onnx(path) if path.suffix in MODULE_SUFFIXES else path
    return _check_outputs(OpenVinoNetwork(graph) if chosen == "openvino" else OnnxNetwork(graph), path)


class OpenVinoNetwork:
    """Network from an .onnx or .xml in OpenVINO, in bfloat16 where the processor has it."""

    runtime = "openvino"

    def __init__(self, path: Path) -> None:
        """Read and compile the graph; errors as `open_network`."""
        import openvino

        core = openvino.Core()
        try:
            model = core.read_model(path)
        except RuntimeError as err:
            raise _unreadable_error(path, err) from err
        shape = model.inputs[0].get_partial_shape()
        self.input_hw = _input_hw([dim.get_length() if dim.is_static else None for dim in shape], path)
        model.reshape([1, 3, *self.input_hw])
        self.names = _class_names(_openvino_metadata(model, path), path)
        use_bfloat16 = "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        settings = {
            "INFERENCE_NUM_THREADS": min(_THREADS, os.cpu_count() or 1),
            "INFERENCE_PRECISION_HINT": "bf16" if use_bfloat16 else "f32",
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,  # pinned threads could share a core with the servo's
        }
        self._compiled = core.compile_model(model, "CPU", settings)

    def run(self, blob: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return rows and prototypes; see `DetectorNetwork.run`."""
        request = self._compiled.create_infer_request()  # one for each call: several threads may call
        request.infer({0: blob})
        outputs = [request.get_output_tensor(i).data.copy() for i in range(len(self._compiled.outputs))]
        return _split(outputs)


class OnnxNetwork:
    """Network from an .onnx in ONNX Runtime."""

    runtime = "onnxruntime"

    def __init__(self, path: Path) -> None:
        """Read the graph; errors as `open_network`."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = min(_THREADS, os.cpu_count() or 1)
        options.log_severity_level = 3  # errors
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # the servo needs that core
        try:
            self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as err:  # ONNX Runtime's errors have no common class
            raise _unreadable_error(path, err) from err
        entry = self._session.get_inputs()[0]
        self._input = entry.name
        self.input_hw = _input_hw([size if isinstance(size, int) else None for size in entry.shape], path)
        self.names = _class_names(self._session.get_modelmeta().custom_metadata_map, path)

    def run(self, blob: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return rows and prototypes; see `DetectorNetwork.run`."""
        return _split(self._session.run(None, {self._input: blob}))


class TorchNetwork:
    """Network from this project's .npz or ultralytics' .pt in torch, in bfloat16 where the processor has it."""

    runtime = "torch"

    def __init__(self, path: Path) -> None:
        """Load the weights; errors as `open_network`."""
        import torch

        module = load_module(path)
        self.names, self.input_hw = module.names, module.input_hw
        self._network = module.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._use_bfloat16 = has_bfloat16()
        self._worker = single_threaded_workers(1, "detector")

    def run(self, blob: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return rows and prototypes; see `DetectorNetwork.run`."""
        return self._worker.submit(self._run, blob).result()

    def _run(self, blob: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        import torch

        image = torch.from_numpy(blob).to(memory_format=torch.channels_last)
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=self._use_bfloat16):
            outputs = self._network(image)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        return _split([output.float().numpy() for output in outputs])


def _resolve_path(path: Path) -> Path:
    """Return the file at `path`: for a folder, its only .xml."""
    if path.is_dir():
        graphs = sorted(path.glob("*.xml"))
        if len(graphs) != 1:
            raise WeightsError(
                f"the folder {path} holds {len(graphs)} .xml files; an OpenVINO export holds one.",
                code="not_an_openvino_folder",
            )
        path = graphs[0]
    if path.suffix not in (*MODULE_SUFFIXES, ".onnx", ".xml"):
        raise WeightsError(
            f"{path} is no detector; known: .npz (this project), .pt (ultralytics), .onnx, and OpenVINO's .xml or its "
            "folder.",
            code="unknown_weights",
        )
    if path.suffix != ".npz" and not path.is_file():  # the reader of .npz names the command that makes it
        raise WeightsError(
            f"{path} is missing; nothing is downloaded: put the file there, or name another.", code="weights_missing"
        )
    return path


def _split(outputs: Sequence[Any]) -> tuple[np.ndarray, np.ndarray | None]:
    return outputs[0][0], outputs[1][0] if len(outputs) > 1 else None


def _input_hw(shape: list[int | None], path: Path) -> tuple[int, int]:
    if len(shape) != 4 or shape[1] not in (3, None) or shape[0] not in (1, None):
        raise WeightsError(
            f"{path.name} takes {shape}; a detector takes one image (1, 3, H, W).", code="unsupported_input"
        )
    return shape[2] or CAMERA_HW[0], shape[3] or CAMERA_HW[1]


def _class_names(metadata: Mapping[str, str], path: Path) -> tuple[str, ...]:
    """Return the classes that ultralytics writes into an export, as text of {index: name}."""
    try:
        names = ast.literal_eval(metadata["names"])
        return tuple(str(names[i]) for i in range(len(names)))
    except (KeyError, ValueError, SyntaxError, TypeError) as err:
        raise WeightsError(
            f"{path.name} names no classes; export it by ultralytics (yolo export), which writes them into the file.",
            code="no_class_names",
        ) from err


def _openvino_metadata(model: Any, path: Path) -> dict[str, str]:
    """Return the metadata of an export: in the .onnx, or in ultralytics' metadata.yaml next to the .xml."""
    metadata = path.with_name("metadata.yaml")
    if path.suffix == ".xml" and metadata.is_file():
        from hal.base.errors import ConfigError
        from hal.base.files import read_yaml

        try:
            data = read_yaml(metadata, "the detector's")
        except ConfigError as err:
            raise WeightsError(f"{path.name}: {err}", code="no_class_names") from err
        return {key: str(value) for key, value in data.items()} if isinstance(data, dict) else {}
    try:
        return {"names": model.get_rt_info(["framework", "names"]).astype(str)}
    except RuntimeError:
        return {}


def _check_outputs(network: DetectorNetwork, path: Path) -> DetectorNetwork:
    """Return `network` after a run on an empty image, if its outputs are YOLOv8's."""
    try:
        rows, prototypes = network.run(np.zeros((1, 3, *network.input_hw), np.float32))
    except Exception as err:  # the runtimes' errors have no common class
        raise _unreadable_error(path, err) from err
    n_masks = 0 if prototypes is None else len(prototypes)
    flat = rows.ndim == 2 and (prototypes is None or prototypes.ndim == 3)
    if not flat or len(rows) != 4 + len(network.names) + n_masks:
        shapes = ", ".join(str(output.shape) for output in (rows, prototypes) if output is not None)
        raise WeightsError(
            f"{path.name} gives {shapes} for an image and {len(network.names)} classes; a YOLOv8 that detects or "
            f"segments, exported without nms, gives ({4 + len(network.names)} + M, A) and, with masks, (M, h, w).",
            code="unsupported_output",
        )
    return network


def _unreadable_error(path: Path, err: Exception) -> WeightsError:
    reason = str(err).strip().splitlines()[-1][:160]
    return WeightsError(f"{path.name} cannot be read as a detector's graph: {reason}", code="unreadable_graph")

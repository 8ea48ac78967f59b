"""Common part of NVIDIA's GraspGen and GraspGenX as generators: frames, seeds, threads, construction."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from models.nvidia.errors import GeneratorError
from models.types import GraspGenerator, GraspSet, check_object_cloud
from models.weights_file import single_threaded_workers

T_NVIDIA_GRASP = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""(4, 4) this project's grasp frame in NVIDIA's: both approach along z; NVIDIA's closes along x, ours along y."""
T_NVIDIA_GRASP.setflags(write=False)

ENVIRONMENTS_FOLDER = Path(__file__).resolve().parents[2] / ".z1" / "generators"
"""Folder of the environments that `python -m scripts.train.make_generator_env` makes, one for each generator."""
_MODULES = {"graspgen": "models.nvidia.graspgen", "graspgenx": "models.nvidia.graspgenx"}
"""Adapter modules by name; lazy, since either package may be missing."""
_MAX_POINTS = 2000  # the number of points that GraspGen is trained with (`num_points` of its configuration)
_MIN_TORCH = (2, 6)  # since then torch.load runs no code from a checkpoint


class NvidiaSampler:
    """A `GraspGenerator` around a sampler of NVIDIA's.

    Its poses are of the gripper's base link; they are moved to the fingertips and turned by `T_NVIDIA_GRASP`. It gives
    no widths. It sorts within one batch only and drops scores below a threshold; here the whole batch is returned,
    sorted. On a CPU the same seed gives the same grasps.
    """

    def __init__(self, sampler: Any, T_base_tip: np.ndarray, source: str, max_points: int = _MAX_POINTS) -> None:
        """Store NVIDIA's sampler and the fingertips' pose T_base_tip (4, 4), in its frames."""
        self._sampler = sampler
        self._T_base_grasp = T_base_tip @ T_NVIDIA_GRASP
        self._source = source
        self._max_points = max_points
        # One worker: the network keeps the grasp count as state, and draws from the process's global random numbers.
        self._worker = single_threaded_workers(1, source)

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m], best score first; widths are NaN.

        Raises:
            InvalidValueError: fewer than 30 points, points not finite, all in one place, or not in metres.
            GeneratorError: the network returned fewer than `n` finite grasps.
        """
        points = check_object_cloud(points, n)
        kept = points[np.random.default_rng(seed).permutation(len(points))[: self._max_points]]
        center = kept.mean(axis=0)
        T, scores = self._worker.submit(self._run, kept - center, n, seed).result()
        if len(T) != n or not (np.isfinite(T).all() and np.isfinite(scores).all()):
            raise GeneratorError(
                f"{self._source} gave {len(T)} of {n} grasps, or numbers that are not finite; check the checkpoint.",
                code="bad_output",
            )
        T[:, :3, 3] += center
        T[:, 3] = [0.0, 0.0, 0.0, 1.0]
        order = np.argsort(-scores, kind="stable")
        return GraspSet(
            T_camera_grasps=(T @ self._T_base_grasp)[order],
            scores=np.clip(scores[order], 0.0, 1.0),
            widths_m=np.full(n, np.nan),
            source=self._source,
        )

    def _run(self, points: np.ndarray, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return NVIDIA's poses (N, 4, 4) and scores (N,) for centred `points` (M, 3), in its order."""
        import torch

        from models.nvidia.torch_patches import cuda_if_available, seed_random_numbers

        with cuda_if_available(), seed_random_numbers(seed):
            cloud = torch.from_numpy(points.astype(np.float32)).cuda()
            # Its outlier removal compares all pairs and empties a sparse cloud; the segmentation has removed them.
            T, scores, _ = self._sampler.sample(cloud, threshold=-1.0, num_grasps=n, remove_outliers=False)
        return T.double().cpu().numpy(), scores.double().cpu().numpy()


def make_nvidia_generator(
    name: str, checkpoint: Path | None, *, own_process: bool, python: Path | None = None
) -> GraspGenerator:
    """Return `graspgen` or `graspgenx` with the checkpoint that the user brought.

    Raises:
        GeneratorError: checkpoint, package or Python is missing, or they do not fit together.
    """
    if checkpoint is None:
        wanted = "the .yml of a GraspGen checkpoint" if name == "graspgen" else "the folder that holds gen/ and dis/"
        raise GeneratorError(
            f"{name} comes without weights; name yours, {wanted}, by --generator-weights.", code="no_weights"
        )
    log_licence(name)
    if not own_process:
        return load_in_process(name, checkpoint)
    from models.nvidia.process import ProcessGenerator

    python = python or ENVIRONMENTS_FOLDER / name / "bin" / "python"
    if not python.is_file():
        raise GeneratorError(
            f"there is no Python at {python}; make one with `python -m scripts.train.make_generator_env {name}`, "
            "or name yours by generator_options.python.",
            code="python_missing",
        )
    return ProcessGenerator(name, checkpoint, python)


def load_in_process(name: str, checkpoint: Path) -> GraspGenerator:
    """Return `graspgen` or `graspgenx`, loaded into this process.

    Raises:
        GeneratorError: as `make_nvidia_generator`.
    """
    return import_module(_MODULES[name]).load(checkpoint)


def log_licence(name: str) -> None:
    """Log once in a process the licence's conditions of `name`."""
    import_module(_MODULES[name]).log_licence_once()


def require_package(package: str, extra: str) -> None:
    """Check that `package` and a torch that opens checkpoints safely can be imported.

    Raises:
        GeneratorError: one is missing; the message names the command that installs it.
    """
    import importlib.util

    if importlib.util.find_spec(package) is None:
        raise GeneratorError(
            f"{package} is not installed here; run `uv sync --inexact --extra {extra}`, or keep it apart: "
            f"`python -m scripts.train.make_generator_env {extra}` and generator_options: {{process: own}}.",
            code="package_missing",
        )
    import torch

    version = tuple(int(part) for part in torch.__version__.split(".")[:2])
    if version < _MIN_TORCH:
        raise GeneratorError(
            f"torch {torch.__version__} would run code from a checkpoint; install 2.6 or later.", code="old_torch"
        )


def load_guarded(name: str, load: Callable[[], Any]) -> Any:
    """Return the result of `load`, whose errors name the file `name`.

    Raises:
        GeneratorError: `load` failed.
    """
    try:
        return load()
    except GeneratorError as err:
        raise GeneratorError(f"{name} cannot be loaded: {err}", code=err.code) from err
    except (
        Exception
    ) as err:  # NVIDIA's loaders raise AssertionError, KeyError, RuntimeError, UnpicklingError and others
        raise GeneratorError(
            f"{name} cannot be loaded: {type(err).__name__}: {err}", code="checkpoint_unreadable"
        ) from err

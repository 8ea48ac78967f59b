"""What NVIDIA's GraspGen and GraspGenX have in common as generators: frames, seeds, threads, and how they are made."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from models.nvidia.errors import GeneratorError
from models.torch_threads import single_threaded_workers
from models.types import GraspGenerator, GraspSet, check_object_cloud

T_NVIDIA_GRASP = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""(4, 4) our grasp frame in theirs: both approach along z, but their jaws close along x and ours along y."""
T_NVIDIA_GRASP.setflags(write=False)

ENVIRONMENTS = Path(__file__).resolve().parents[2] / ".z1" / "generators"
"""Where `python -m scripts.train.make_generator_env` puts an environment for each."""
_MODULES = {"graspgen": "models.nvidia.graspgen", "graspgenx": "models.nvidia.graspgenx"}
"""By name, so that neither package is imported before it is asked for."""
_MAX_POINTS = 2000
_MIN_TORCH = (2, 6)  # since then torch.load runs no code out of a checkpoint


class NvidiaSampler:
    """A `GraspGenerator` around a sampler of theirs.

    Their poses are those of the gripper's base link: ours lie at the fingertips, turned by `T_NVIDIA_GRASP`. They say
    nothing of widths. Theirs sorts within a try only and drops what is below a threshold; here all of one try come,
    sorted. On a CPU the same seed gives the same grasps.
    """

    def __init__(self, sampler: Any, T_base_tip: np.ndarray, source: str, max_points: int = _MAX_POINTS) -> None:
        """Take their sampler and the fingertips' pose T_base_tip (4, 4), in their frames."""
        self._sampler = sampler
        self._T_base_grasp = T_base_tip @ T_NVIDIA_GRASP
        self._source = source
        self._max_points = max_points
        # One worker: they keep the count of grasps in the network, and draw from the process's global numbers.
        self._worker = single_threaded_workers(1, source)

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m], best score first; widths are NaN.

        Raises:
            ValueError: fewer than 30 points, points not finite, all in one place, or not in metres.
            GeneratorError: the network gave something else than n numbers.
        """
        points = check_object_cloud(points, n)
        kept = points[np.random.default_rng(seed).permutation(len(points))[: self._max_points]]
        center = kept.mean(axis=0)
        T, scores = self._worker.submit(self._run, kept - center, n, seed).result()
        if len(T) != n or not (np.isfinite(T).all() and np.isfinite(scores).all()):
            raise GeneratorError(f"{self._source} gave {len(T)} grasps of {n} with numbers; is the checkpoint whole?")
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
        """Return their poses (N, 4, 4) and scores (N,) for `points` (M, 3) about the origin, in their order."""
        import torch

        from models.nvidia.torch_patches import cuda_only_if_there, drawn_from

        with cuda_only_if_there(), drawn_from(seed):
            cloud = torch.from_numpy(points.astype(np.float32)).cuda()
            # Their removal of outliers compares all pairs and keeps nothing of a sparse cloud: ours has been done.
            T, scores, _ = self._sampler.sample(cloud, threshold=-1.0, num_grasps=n, remove_outliers=False)
        return T.double().cpu().numpy(), scores.double().cpu().numpy()


def make_nvidia_generator(
    name: str, checkpoint: Path | None, *, own_process: bool, python: Path | None = None
) -> GraspGenerator:
    """Return `graspgen` or `graspgenx` with the checkpoint that the user brought.

    Raises:
        GeneratorError: there is no checkpoint, no package or no Python for it, or they do not fit together.
    """
    if checkpoint is None:
        wanted = "the .yml of a GraspGen checkpoint" if name == "graspgen" else "the folder that holds gen/ and dis/"
        raise GeneratorError(f"{name} comes without weights; name yours, {wanted}, by --generator-weights.")
    say_licence(name)
    if not own_process:
        return load_here(name, checkpoint)
    from models.nvidia.process import ProcessGenerator

    python = python or ENVIRONMENTS / name / "bin" / "python"
    if not python.is_file():
        raise GeneratorError(
            f"there is no Python at {python}; make one with `python -m scripts.train.make_generator_env {name}`, "
            "or name yours by generator_python."
        )
    return ProcessGenerator(name, checkpoint, python)


def load_here(name: str, checkpoint: Path) -> GraspGenerator:
    """Return `graspgen` or `graspgenx`, loaded into this process.

    Raises:
        GeneratorError: as `make_nvidia_generator`.
    """
    return import_module(_MODULES[name]).load(checkpoint)


def say_licence(name: str) -> None:
    """Say once in a process what the licence of `name` asks."""
    import_module(_MODULES[name]).say_licence_once()


def require_package(package: str, extra: str) -> None:
    """Check that `package` and a torch that opens checkpoints safely can be imported.

    Raises:
        GeneratorError: not so; the message says how to get them.
    """
    import importlib.util

    if importlib.util.find_spec(package) is None:
        raise GeneratorError(
            f"{package} is not installed here; run `uv sync --inexact --extra {extra}`, or keep it apart: "
            f"`python -m scripts.train.make_generator_env {extra}` and generator_process: own."
        )
    import torch

    seen = tuple(int(part) for part in torch.__version__.split(".")[:2])
    if seen < _MIN_TORCH:
        raise GeneratorError(f"torch {torch.__version__} would run code out of a checkpoint; install 2.6 or later.")


def load_guarded(what: str, load: Callable[[], Any]) -> Any:
    """Return what `load` returns; whatever their code raises says which file it was about.

    Raises:
        GeneratorError: `load` failed.
    """
    try:
        return load()
    except Exception as err:  # their loaders assert, and raise KeyError, RuntimeError, UnpicklingError and others
        raise GeneratorError(f"{what} cannot be loaded: {type(err).__name__}: {err}") from err

"""Grasps by diffusion: the trained networks behind the contract that all generators share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from hal.base.errors import InvalidValueError
from models.diffusion.cloud import ViewCloud, prepare_cloud
from models.diffusion.selection import choose_grasps
from models.torch_threads import has_bfloat16, single_threaded_workers
from models.types import GraspSet, check_object_cloud

Device = Literal["auto", "cpu", "cuda"]
_MIN_WIDTH_M = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffusionConfig:
    """Which weights, and how they are sampled."""

    gripper: str = "agnostic"
    """The hand the weights were trained for; they lie in `models/weights/graspgen_<gripper>.npz`."""
    weights: Path | None = None
    """Another weights file, its checksum beside it."""
    steps: int = 8
    """Denoising steps."""
    temperature: float = 0.78
    """Spread of the starting noise; below 1 grasps are safer and less varied."""
    drawn: float = 2.25
    """Grasps drawn for each that is given out: the discriminator keeps the rest back. 1 gives out all."""
    threads: int = 2
    """Parts that the grasps are denoised in, side by side, on a CPU."""
    device: Device = "auto"
    """Where the networks run; `auto` takes CUDA where there is."""
    max_width_m: float = 0.136
    """Widths are given up to this opening [m]."""

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= 100:
            raise InvalidValueError(f"steps is {self.steps}; allowed is 1 to 100.")
        if not 1 <= self.threads <= 64:
            raise InvalidValueError(f"threads is {self.threads}; allowed is 1 to 64.")
        if not 0.0 < self.temperature <= 1.5:
            raise InvalidValueError(f"temperature is {self.temperature}; allowed is above 0, up to 1.5.")
        if not 1.0 <= self.drawn <= 10.0:
            raise InvalidValueError(f"drawn is {self.drawn}; allowed is 1 to 10.")
        if self.device not in get_args(Device):
            raise InvalidValueError(f"device is {self.device!r}; allowed: {', '.join(get_args(Device))}.")


class DiffusionSampler:
    """A `GraspGenerator` that denoises random poses into grasps and lets its discriminator score them.

    The recipe is that of GraspGen (Murali et al. 2025): diffusion over poses conditioned on the cloud, and a
    discriminator trained on the generator's own samples. Networks, data and weights are this project's own.
    The view ray is known (clouds are seen from their origin); arm, table and gravity are not.
    """

    def __init__(self, config: DiffusionConfig | None = None) -> None:
        """Load the weights.

        Raises:
            WeightsError: they are missing, damaged or of another network.
            ValueError: CUDA is asked for where there is none.
        """
        from models.diffusion.weights import load_weights, weights_path

        self.config = config or DiffusionConfig()
        self._device = _pick_device(self.config.device)
        path = self.config.weights or weights_path(self.config.gripper)
        generator, discriminator = load_weights(path)
        self._generator, self._discriminator = generator.to(self._device), discriminator.to(self._device)
        self._quick = self._device == "cpu" and has_bfloat16()
        self._workers = single_threaded_workers(self.config.threads, "graspgen")
        # What the first call compiles and allocates shall not be waited for when an object stands there.
        self.sample(np.random.default_rng(0).uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (600, 3)), 800, 0)

    @property
    def device(self) -> str:
        """Where the networks run: `cpu` or `cuda`."""
        return self._device

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m] seen from their origin, best score first.

        They are the best of `drawn` times as many; see `choose_grasps`. On one device the same seed gives the same
        grasps.

        Raises:
            ValueError: fewer than 30 points, points not finite, all in one place, or not in metres.
        """
        return self.sample_batch([points], n, seed)[0]

    def sample_batch(self, clouds: Sequence[np.ndarray], n: int, seed: int) -> list[GraspSet]:
        """Return for each of several objects what `sample` returns for its cloud; on a GPU all are denoised at once.

        Raises:
            ValueError: as `sample`; for several clouds it says which one (from 0).
        """
        grasps = []
        for cloud, T, widths, scores in self._draw(clouds, math.ceil(self.config.drawn * n), seed):
            chosen = choose_grasps(T, scores, n)
            grasps.append(self._as_set(cloud, T[chosen], widths[chosen], scores[chosen]))
        return grasps

    def draw(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return the generator's own `n` grasps as they come, scored, none kept back.

        Raises:
            ValueError: as `sample`.
        """
        return self._as_set(*self._draw([points], n, seed)[0])

    def _as_set(self, cloud: ViewCloud, T: np.ndarray, widths: np.ndarray, scores: np.ndarray) -> GraspSet:
        return GraspSet(
            T_camera_grasps=cloud.T_camera_view @ T,
            scores=scores,
            widths_m=np.clip(widths, _MIN_WIDTH_M, self.config.max_width_m),
            source=f"diffusion-{self.config.gripper}",
        )

    def _draw(self, clouds: Sequence[np.ndarray], n: int, seed: int) -> list[tuple[ViewCloud, *tuple[np.ndarray, ...]]]:
        """Return for each cloud how the networks saw it, poses (n, 4, 4) in its frame, widths (n,) [m], scores (n,)."""
        from models.diffusion.network import N_COORDINATES

        checked = _checked(clouds, n)
        seen, noise = [], []
        for points in checked:
            rng = np.random.default_rng(seed)
            seen.append(prepare_cloud(points, rng))
            noise.append(self.config.temperature * even_normal(n, N_COORDINATES, rng))
        inputs = np.stack([np.concatenate([cloud.points, cloud.normals], axis=1) for cloud in seen])
        return list(zip(seen, *self._denoise(inputs, np.stack(noise)), strict=True))

    def _denoise(self, clouds: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return poses (B, n, 4, 4), widths (B, n) [m] and scores (B, n) for clouds (B, 512, 6), noise (B, n, 10)."""
        import torch

        from models.diffusion.network import decode_grasps

        def denoise(job: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            cloud, start = (torch.from_numpy(array.astype(np.float32)).to(self._device) for array in job)
            with torch.inference_mode():
                with torch.autocast("cpu", torch.bfloat16, enabled=self._quick):  # as it was trained
                    grasps = self._generator.sample(cloud, start, self.config.steps)
                scores = torch.sigmoid(self._discriminator(cloud, grasps))
                T, widths = decode_grasps(grasps.flatten(0, 1).cpu().double())
            return T.numpy(), widths.numpy(), scores.flatten().cpu().double().numpy()

        jobs = [(clouds, noise)]  # a GPU wants all at once, a CPU one part for each core
        if self._device == "cpu":
            split = min(self.config.threads, noise.shape[1])
            jobs = [
                (clouds[b : b + 1], part)
                for b in range(len(clouds))
                for part in np.array_split(noise[b : b + 1], split, axis=1)
            ]
        T, widths, scores = (np.concatenate(parts) for parts in zip(*self._workers.map(denoise, jobs), strict=True))
        shape = noise.shape[:2]
        return T.reshape(*shape, 4, 4), widths.reshape(shape), scores.reshape(shape)


def even_normal(n: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """Return standard normal noise (n, dimensions) that fills its space more evenly than independent draws.

    A scrambled Sobol sequence: denoising is deterministic, so evenly spread noise covers more kinds of grasps.
    """
    from scipy.special import ndtri
    from scipy.stats.qmc import Sobol

    sequence = Sobol(dimensions, scramble=True, rng=rng).random_base2(max(n - 1, 1).bit_length())[:n]
    return ndtri(np.clip(sequence, 1e-6, 1.0 - 1e-6))


def _checked(clouds: Sequence[np.ndarray], n: int) -> list[np.ndarray]:
    if not len(clouds):
        raise InvalidValueError("No cloud was given; give at least one object's points.")
    checked = []
    for index, points in enumerate(clouds):
        try:
            checked.append(check_object_cloud(points, n))
        except ValueError as err:
            raise InvalidValueError(f"Cloud {index} of {len(clouds)}: {err}" if len(clouds) > 1 else str(err)) from err
    return checked


def _pick_device(wanted: Device) -> str:
    import torch

    there = torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise InvalidValueError("device is 'cuda', but torch finds no CUDA device here; take 'auto' or 'cpu'.")
    return "cuda" if there and wanted != "cpu" else "cpu"

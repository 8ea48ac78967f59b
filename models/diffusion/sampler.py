"""Grasp generator by diffusion: the trained networks as a `GraspGenerator`, and the choice among what they draw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numba import njit

from hal.base.errors import InvalidValueError
from models.diffusion.cloud import ViewCloud, prepare_cloud
from models.types import GraspSet, check_object_cloud
from models.weights_file import has_bfloat16, single_threaded_workers

_NEAR_M = 0.010
_NEAR_RAD = np.deg2rad(15.0)
_NOVELTY = 4.0  # with the exponent chosen among 13 settings, see `choose_grasps`
_CHANCE_EXPONENT = 1.5


def choose_grasps(T: np.ndarray, scores: np.ndarray, n: int) -> np.ndarray:
    """Return the indices (n,) of the grasps of highest value, best score first.

    A grasp with chance c has the value c^1.5 · (1 + 4 m), m being the chance that nothing better near it holds: so the
    best of each place precedes the twentieth of another, and a higher valid ratio does not cost coverage. Grasps are
    near within 1 cm and 15° of both approach and closing axis. These numbers were chosen among 13 settings on 30 of
    the evaluation clouds of known families; held-out families were not used.

    Args:
        T: (M, 4, 4) grasps, M ≥ n.
        scores: (M,) chance that each holds.
        n: number of grasps to choose.
    """
    order = np.argsort(-scores, kind="stable")
    # A chance of 1 would make the log of its complement infinite
    chances = np.clip(scores[order], 0.0, 0.999)
    places, approaches, closings = (np.ascontiguousarray(T[order, :3, column]) for column in (3, 2, 1))
    nothing_better = np.exp(_log_missed(places, approaches, closings, np.log1p(-chances)))
    chosen = np.argsort(-(chances**_CHANCE_EXPONENT) * (1.0 + _NOVELTY * nothing_better), kind="stable")[:n]
    return order[np.sort(chosen)]


@njit(cache=True)
def _log_missed(places, approaches, closings, log_missed):
    """Return for each grasp (M,) the log of the chance that no earlier grasp near it holds."""
    near_squared, near_cos = _NEAR_M**2, np.cos(_NEAR_RAD)
    total = np.zeros(len(places))
    for i in range(len(places)):
        for j in range(i):
            x, y, z = places[i, 0] - places[j, 0], places[i, 1] - places[j, 1], places[i, 2] - places[j, 2]
            if x * x + y * y + z * z > near_squared:
                continue
            a, b = approaches[i], approaches[j]
            if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] < near_cos:
                continue
            c, d = closings[i], closings[j]
            if abs(c[0] * d[0] + c[1] * d[1] + c[2] * d[2]) >= near_cos:
                total[i] += log_missed[j]
    return total


Device = Literal["auto", "cpu", "cuda"]
_MIN_WIDTH_M = 0.002  # narrower than the narrowest object of the training data (4 mm)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffusionConfig:
    """Weights, and the settings of the sampling."""

    gripper: str = "agnostic"
    """Gripper that the weights were trained for, see `models.diffusion.network.weights_path`."""
    weights: Path | None = None
    """Another weights file, with its checksum next to it."""
    # Steps and temperature were chosen among ten settings on the evaluation clouds (models/weights/README.md)
    steps: int = 8
    """Denoising steps."""
    temperature: float = 0.78
    """Spread of the starting noise; below 1 grasps are safer and less varied."""
    oversampling: float = 2.25
    """Grasps drawn for each that is returned: the discriminator drops the rest. 1 returns all."""
    threads: int = 2
    """Parts in which the grasps are denoised in parallel on a CPU."""
    device: Device = "auto"
    """Device of the networks; `auto` takes CUDA where available."""
    max_width_m: float = 0.136
    """Upper limit of the returned widths [m]."""

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= 100:
            raise InvalidValueError(f"diffusion: steps is {self.steps}; allowed is 1 to 100.", code="diffusion_steps")
        if not 1 <= self.threads <= 64:
            raise InvalidValueError(
                f"diffusion: threads is {self.threads}; allowed is 1 to 64.", code="diffusion_threads"
            )
        if not 0.0 < self.temperature <= 1.5:
            raise InvalidValueError(
                f"diffusion: temperature is {self.temperature}; allowed is above 0, up to 1.5.",
                code="diffusion_temperature",
            )
        if not 1.0 <= self.oversampling <= 10.0:
            raise InvalidValueError(
                f"diffusion: oversampling is {self.oversampling}; allowed is 1 to 10.", code="diffusion_oversampling"
            )
        if self.device not in get_args(Device):
            raise InvalidValueError(
                f"diffusion: device is {self.device!r}; allowed: {', '.join(get_args(Device))}.",
                code="diffusion_device",
            )


class DiffusionSampler:
    """A `GraspGenerator` that denoises random poses into grasps and scores them by its discriminator.

    The recipe is that of GraspGen (Murali et al. 2025): diffusion over poses conditioned on the cloud, and a
    discriminator trained on the generator's own samples. Networks, data and weights are this project's own.
    Clouds are seen from their origin, which gives the view ray; arm, table and gravity are not considered.
    """

    def __init__(self, config: DiffusionConfig | None = None) -> None:
        """Load the weights.

        Raises:
            WeightsError: they are missing, damaged or of another network.
            InvalidValueError: CUDA is requested where there is none.
        """
        from models.diffusion.network import load_weights, weights_path

        self.config = config or DiffusionConfig()
        self._device = _choose_device(self.config.device)
        path = self.config.weights or weights_path(self.config.gripper)
        generator, discriminator = load_weights(path)
        self._generator, self._discriminator = generator.to(self._device), discriminator.to(self._device)
        self._use_bfloat16 = self._device == "cpu" and has_bfloat16()
        self._workers = single_threaded_workers(self.config.threads, "diffusion")
        # The first call compiles and allocates: done here, so that no pick waits for it.
        self.sample(np.random.default_rng(0).uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (600, 3)), 800, 0)

    @property
    def device(self) -> str:
        """Device of the networks: `cpu` or `cuda`."""
        return self._device

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m] seen from their origin, best score first.

        They are the best of `oversampling` times as many; see `choose_grasps`. On one device the same seed gives the
        same grasps.

        Raises:
            InvalidValueError: fewer than 30 points, points not finite, all in one place, or not in metres.
        """
        return self.sample_batch([points], n, seed)[0]

    def sample_batch(self, clouds: Sequence[np.ndarray], n: int, seed: int) -> list[GraspSet]:
        """Return the grasps of `sample` for each of several objects' clouds; on a GPU all are denoised at once.

        Raises:
            InvalidValueError: as `sample`; for several clouds it names the index (from 0).
        """
        grasps = []
        for cloud, T, widths, scores in self._draw(clouds, math.ceil(self.config.oversampling * n), seed):
            chosen = choose_grasps(T, scores, n)
            grasps.append(self._as_set(cloud, T[chosen], widths[chosen], scores[chosen]))
        return grasps

    def draw(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps of the generator alone in the order drawn, scored, none dropped.

        Raises:
            InvalidValueError: as `sample`.
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
        """Return for each cloud the networks' input, poses (n, 4, 4) in its frame, widths (n,) [m], scores (n,)."""
        from models.diffusion.network import N_COORDINATES

        prepared, noise = [], []
        for points in _check_clouds(clouds, n):
            rng = np.random.default_rng(seed)
            prepared.append(prepare_cloud(points, rng))
            noise.append(self.config.temperature * draw_even_normal(n, N_COORDINATES, rng))
        inputs = np.stack([np.concatenate([cloud.points, cloud.normals], axis=1) for cloud in prepared])
        return list(zip(prepared, *self._denoise(inputs, np.stack(noise)), strict=True))

    def _denoise(self, clouds: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return poses (B, n, 4, 4), widths (B, n) [m] and scores (B, n) for clouds (B, 512, 6), noise (B, n, 10)."""
        import torch

        from models.diffusion.network import decode_grasps

        def denoise(job: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            cloud, start = (torch.from_numpy(array.astype(np.float32)).to(self._device) for array in job)
            with torch.inference_mode():
                with torch.autocast("cpu", torch.bfloat16, enabled=self._use_bfloat16):  # as in training
                    grasps = self._generator.sample(cloud, start, self.config.steps)
                scores = torch.sigmoid(self._discriminator(cloud, grasps))
                T, widths = decode_grasps(grasps.flatten(0, 1).cpu().double())
            return T.numpy(), widths.numpy(), scores.flatten().cpu().double().numpy()

        jobs = [(clouds, noise)]  # a GPU is fastest with all at once, a CPU with one part for each core
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


def draw_even_normal(n: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """Return standard normal noise (n, dimensions) that fills its space more evenly than independent draws.

    It is a scrambled Sobol sequence: denoising is deterministic, so evenly spread noise covers more kinds of grasps.
    """
    from scipy.special import ndtri
    from scipy.stats.qmc import Sobol

    # A Sobol sequence is balanced only over a power of two points
    sequence = Sobol(dimensions, scramble=True, rng=rng).random_base2(max(n - 1, 1).bit_length())[:n]
    # The normal quantiles of 0 and 1 are infinite
    return ndtri(np.clip(sequence, 1e-6, 1.0 - 1e-6))


def _check_clouds(clouds: Sequence[np.ndarray], n: int) -> list[np.ndarray]:
    if not len(clouds):
        raise InvalidValueError("No cloud was given; give at least one object's points.", code="no_clouds")
    checked = []
    for index, points in enumerate(clouds):
        try:
            checked.append(check_object_cloud(points, n))
        except InvalidValueError as err:
            if len(clouds) == 1:
                raise
            raise InvalidValueError(f"Cloud {index} of {len(clouds)}: {err}", code=err.code) from err
    return checked


def _choose_device(requested: Device) -> str:
    import torch

    available = torch.cuda.is_available()
    if requested == "cuda" and not available:
        raise InvalidValueError(
            "diffusion: device is 'cuda', but torch finds no CUDA device here; take 'auto' or 'cpu'.", code="no_cuda"
        )
    return "cuda" if available and requested != "cpu" else "cpu"

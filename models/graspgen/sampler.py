"""Grasps by diffusion: the trained networks behind the contract that all generators share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.graspgen.cloud import prepare_cloud
from models.torch_threads import single_threaded_workers
from models.types import GraspSet, check_object_cloud


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffusionConfig:
    """Which weights, and how they are sampled."""

    gripper: str = "agnostic"
    """The hand the weights were trained for; they lie in `models/weights/graspgen_<gripper>.npz`."""
    weights: Path | None = None
    """Another weights file, its checksum beside it."""
    steps: int = 6
    """Denoising steps."""
    temperature: float = 1.0
    """Spread of the starting noise; below 1 grasps are safer and less varied."""
    threads: int = 2
    """Parts that the grasps are denoised in, side by side."""
    max_width_m: float = 0.136
    """Widths are given up to this opening [m]."""

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= 100:
            raise ValueError(f"steps is {self.steps}; allowed is 1 to 100.")
        if not 1 <= self.threads <= 64:
            raise ValueError(f"threads is {self.threads}; allowed is 1 to 64.")
        if not 0.0 < self.temperature <= 1.5:
            raise ValueError(f"temperature is {self.temperature}; allowed is above 0, up to 1.5.")


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
        """
        from models.graspgen.weights import load_weights, weights_path

        self.config = config or DiffusionConfig()
        path = self.config.weights or weights_path(self.config.gripper)
        self._generator, self._discriminator = load_weights(path)
        self._workers = single_threaded_workers(self.config.threads, "graspgen")
        # What the first call compiles and allocates shall not be waited for when an object stands there.
        self.sample(np.random.default_rng(0).uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (600, 3)), 800, 0)

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m] seen from their origin, best score first.

        Raises:
            ValueError: fewer than 30 points, points not finite, all in one place, or not in metres.
        """
        points = check_object_cloud(points, n)
        rng = np.random.default_rng(seed)
        cloud = prepare_cloud(points, rng)
        T_view_grasps, widths, scores = self._denoise(cloud.points, cloud.normals, n, rng)
        order = np.argsort(-scores, kind="stable")
        return GraspSet(
            T_camera_grasps=cloud.T_camera_view @ T_view_grasps[order],
            scores=scores[order],
            widths_m=np.clip(widths[order], 0.002, self.config.max_width_m),
            source=f"diffusion-{self.config.gripper}",
        )

    def _denoise(
        self, points: np.ndarray, normals: np.ndarray, n: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return poses (n, 4, 4) in the view frame, widths (n,) [m] and scores (n,)."""
        import torch

        from models.graspgen.network import N_COORDINATES, decode_grasps

        cloud = torch.from_numpy(np.concatenate([points, normals], axis=1).astype(np.float32))[None]
        noise = self.config.temperature * rng.standard_normal((1, n, N_COORDINATES))

        def denoise(part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            with torch.inference_mode():
                grasps = self._generator.sample(cloud, torch.from_numpy(part.astype(np.float32)), self.config.steps)
                scores = torch.sigmoid(self._discriminator(cloud, grasps))
                T, widths = decode_grasps(grasps[0].double())
            return T.numpy(), widths.numpy(), scores[0].double().numpy()

        parts = np.array_split(noise, min(self.config.threads, n), axis=1)
        T, widths, scores = zip(*self._workers.map(denoise, parts), strict=True)
        return np.concatenate(T), np.concatenate(widths), np.concatenate(scores)

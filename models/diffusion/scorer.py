"""Scores by the learned discriminator for grasps that anybody proposed."""

from __future__ import annotations

import numpy as np

from models.diffusion.cloud import prepare_cloud
from models.diffusion.sampler import DiffusionConfig
from models.torch_threads import single_threaded_workers
from models.types import GraspSet, check_object_cloud

_PAD_HALF_WIDTH_M = 0.011  # of the hand that the weights were trained for
_PAD_REACH_M = 0.03
_MIN_WIDTH_M = 0.002
_UNSEEN_WIDTH_M = 0.055  # the mean of the training data


class GraspScorer:
    """Judges grasps by the discriminator of a `DiffusionSampler`'s weights: the chance that each holds.

    It was trained on grasps whose fingertips reach 4 to 20 mm past the contacts, on clouds of one object, seen from
    their origin. Safe to call from several threads.
    """

    def __init__(self, config: DiffusionConfig | None = None) -> None:
        """Load the weights that `config` names; of the rest of it only `threads` and `max_width_m` count.

        Raises:
            WeightsError: they are missing, damaged or of another network.
        """
        from models.diffusion.weights import load_weights, weights_path

        self.config = config or DiffusionConfig()
        _, self._discriminator = load_weights(self.config.weights or weights_path(self.config.gripper))
        self._workers = single_threaded_workers(self.config.threads, "grasp-scorer")

    def score(self, points: np.ndarray, grasps: GraspSet, seed: int = 0) -> np.ndarray:
        """Return scores (N,) in [0, 1] of `grasps` on the object's `points` (M, 3) [m], in one frame with them.

        Widths that nobody told are measured in the cloud. The seed draws the points that the network sees.

        Raises:
            ValueError: no grasps; fewer than 30 points, points not finite, all in one place, or not in metres.
        """
        import torch

        from models.diffusion.network import encode_grasps

        points = check_object_cloud(points, len(grasps))
        cloud = prepare_cloud(points, np.random.default_rng(seed))
        T_view_grasps = np.linalg.inv(cloud.T_camera_view) @ grasps.T_camera_grasps
        widths = np.array(grasps.widths_m)
        untold = ~np.isfinite(widths)
        widths[untold] = measure_widths(cloud.points, T_view_grasps[untold])
        encoded = encode_grasps(
            torch.from_numpy(T_view_grasps), torch.from_numpy(np.clip(widths, _MIN_WIDTH_M, self.config.max_width_m))
        ).float()
        seen = torch.from_numpy(np.concatenate([cloud.points, cloud.normals], axis=1).astype(np.float32))[None]

        def judge(part: torch.Tensor) -> np.ndarray:
            with torch.inference_mode():
                return torch.sigmoid(self._discriminator(seen, part[None]))[0].double().numpy()

        parts = torch.tensor_split(encoded, min(self.config.threads, len(encoded)))
        return np.concatenate(list(self._workers.map(judge, parts)))


def measure_widths(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return how wide (N,) the object is between the pads of grasps `T` (N, 4, 4) [m], as far as `points` (M, 3) show.

    The pads close on the middle, so the side that is seen tells of both. Where there is no point between the pads
    the width is a usual one.
    """
    widths = np.full(len(T), _UNSEEN_WIDTH_M)
    for index, pose in enumerate(T):
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        between = (np.abs(x) < _PAD_HALF_WIDTH_M) & (z < 0.0) & (z > -_PAD_REACH_M)
        if between.any():
            widths[index] = max(2.0 * float(np.abs(y[between]).max()), _MIN_WIDTH_M)
    return widths

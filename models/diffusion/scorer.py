"""Scores by the learned discriminator for grasps of any generator."""

from __future__ import annotations

import numpy as np

from hal.base.transforms import inverse
from models.diffusion.cloud import prepare_cloud
from models.diffusion.sampler import DiffusionConfig
from models.types import GraspSet, check_object_cloud
from models.weights_file import single_threaded_workers

_PAD_HALF_WIDTH_M = 0.011  # half the finger width of the gripper that the weights were trained for
_PAD_REACH_M = 0.03
_MIN_WIDTH_M = 0.002
_DEFAULT_WIDTH_M = 0.055  # the mean of the training data


class GraspScorer:
    """Scorer by the discriminator of a `DiffusionSampler`'s weights: the probability that a grasp holds.

    It was trained on grasps whose fingertips reach 4 to 20 mm past the contacts, on clouds of one object, seen from
    their origin. Safe to call from several threads.
    """

    def __init__(self, config: DiffusionConfig | None = None) -> None:
        """Load the weights that `config` names; of its other fields only `threads` and `max_width_m` are used.

        Raises:
            WeightsError: they are missing, damaged or of another network.
        """
        from models.diffusion.network import load_weights, weights_path

        self.config = config or DiffusionConfig()
        _, self._discriminator = load_weights(self.config.weights or weights_path(self.config.gripper))
        self._workers = single_threaded_workers(self.config.threads, "grasp-scorer")

    def score(self, points: np.ndarray, grasps: GraspSet, seed: int = 0) -> np.ndarray:
        """Return scores (N,) in [0, 1] of `grasps` on the object's `points` (M, 3) [m], in one frame with them.

        Missing widths are measured in the cloud. The seed draws the points of the network's input.

        Raises:
            InvalidValueError: no grasps; fewer than 30 points, points not finite, all in one place, or not in metres.
        """
        import torch

        from models.diffusion.network import encode_grasps

        points = check_object_cloud(points, len(grasps))
        cloud = prepare_cloud(points, np.random.default_rng(seed))
        T_view_grasps = inverse(cloud.T_camera_view) @ grasps.T_camera_grasps
        widths = np.array(grasps.widths_m)
        missing = ~np.isfinite(widths)
        widths[missing] = measure_widths(cloud.points, T_view_grasps[missing])
        encoded = encode_grasps(
            torch.from_numpy(T_view_grasps), torch.from_numpy(np.clip(widths, _MIN_WIDTH_M, self.config.max_width_m))
        ).float()
        features = torch.from_numpy(np.concatenate([cloud.points, cloud.normals], axis=1).astype(np.float32))[None]

        def score_part(part: torch.Tensor) -> np.ndarray:
            with torch.inference_mode():
                return torch.sigmoid(self._discriminator(features, part[None]))[0].double().numpy()

        parts = torch.tensor_split(encoded, min(self.config.threads, len(encoded)))
        return np.concatenate(list(self._workers.map(score_part, parts)))


def measure_widths(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return widths (N,) of the object between the pads of grasps `T` (N, 4, 4) [m], from its `points` (M, 3).

    The pads close on the middle, so one visible side gives the width. Without a point between the pads it is the mean
    width of the training data.
    """
    widths = np.full(len(T), _DEFAULT_WIDTH_M)
    for index, pose in enumerate(T):
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        between = (np.abs(x) < _PAD_HALF_WIDTH_M) & (z < 0.0) & (z > -_PAD_REACH_M)
        if between.any():
            widths[index] = max(2.0 * float(np.abs(y[between]).max()), _MIN_WIDTH_M)
    return widths

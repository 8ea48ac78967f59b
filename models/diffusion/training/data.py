"""Training batches from shards of shapes, views and grasps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hal.base.errors import MissingFileError
from models.diffusion.network import POSITION_SCALE_M
from models.diffusion.training.solids import Solid

_FRONT_WEIGHT = 3.0  # a grasp along the view ray is drawn 1 + 3 times as often as one from the side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspData:
    """Concatenated shards: V views of S shapes."""

    clouds: np.ndarray
    """(V, 512, 6) points [m] and normals in the view frame."""
    T_view_object: np.ndarray
    """(V, 4, 4)."""
    shape: np.ndarray
    """(V,) index of the shape in each view."""
    grasps: np.ndarray
    """(S, G, 4, 4) ground truth in the object frame; repeated where a shape has fewer."""
    widths_m: np.ndarray
    """(S, G) distance between their contacts [m]."""
    parts: np.ndarray
    """(S, P, 18) the solids."""
    profiles: np.ndarray
    """(S, P, 24, 2)."""
    family: np.ndarray
    """(S,) names."""

    def solid(self, view: int) -> Solid:
        """Return the solid in a view."""
        s = self.shape[view]
        return Solid(family=str(self.family[s]), parts=self.parts[s], profiles=self.profiles[s])

    def draw_grasps(self, views: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return grasps (B, count, 4, 4) in the view frames and widths (B, count), those from the front more often."""
        shapes = self.shape[views]
        approach_z = np.einsum("bj,bgj->bg", self.T_view_object[views, 2, :3], self.grasps[shapes][:, :, :3, 2])
        weights = 1.0 + _FRONT_WEIGHT * np.maximum(approach_z, 0.0) ** 2
        bounds = np.cumsum(weights, axis=1)
        marks = rng.random((len(views), count)) * bounds[:, -1:]
        picks = np.stack([np.searchsorted(b, m) for b, m in zip(bounds, marks, strict=True)])
        # A mark that rounding puts on the last bound is found one past the end
        picks = np.minimum(picks, self.grasps.shape[1] - 1)
        rows = np.arange(len(views))[:, None]
        return self.T_view_object[views][:, None] @ self.grasps[shapes[rows], picks], self.widths_m[shapes[rows], picks]


def load_shards(folder: Path, limit: int | None = None) -> GraspData:
    """Return the shards in `folder` as one data set.

    Raises:
        MissingFileError: there are none.
    """
    paths = sorted(folder.glob("*.npz"))[:limit]
    if not paths:
        raise MissingFileError(f"No shards in {folder}; run `python -m scripts.train.make_grasp_dataset` first.")
    shards = [np.load(path, allow_pickle=False) for path in paths]
    firsts = np.cumsum([0] + [len(s["family"]) for s in shards[:-1]])
    keys = ("clouds", "T_view_object", "grasps", "widths_m", "parts", "profiles", "family")
    joined = {key: np.concatenate([s[key] for s in shards]) for key in keys}
    return GraspData(shape=np.concatenate([s["shape"] + f for s, f in zip(shards, firsts, strict=True)]), **joined)


def augment(cloud: Tensor, grasps: Tensor, symmetric: bool = True) -> tuple[Tensor, Tensor]:
    """Return clouds (B, N, 6) and grasps (B, K, 10) mirrored, turned, scaled and shifted together.

    Grippers are symmetric along x, so both image axes may be mirrored; the turn is about the view ray. Those that are
    `symmetric` along y too, as parallel grippers are, may also be turned over.
    """
    batch = len(cloud)
    angle = 0.15 * torch.randn(batch)
    mirror = torch.where(torch.rand(batch, 2) < 0.5, -1.0, 1.0)
    R = torch.zeros(batch, 3, 3)
    R[:, 0, 0], R[:, 0, 1] = angle.cos() * mirror[:, 0], -angle.sin() * mirror[:, 1]
    R[:, 1, 0], R[:, 1, 1] = angle.sin() * mirror[:, 0], angle.cos() * mirror[:, 1]
    R[:, 2, 2] = 1.0
    scale = 1.0 + 0.04 * torch.randn(batch, 1, 1)
    shift = 0.003 * torch.randn(batch, 1, 3)
    Rt = R.transpose(1, 2)
    points = cloud[..., :3] @ Rt * scale + shift + 0.0005 * torch.randn_like(cloud[..., :3])
    turned = torch.cat([points, cloud[..., 3:] @ Rt], dim=-1)
    position = grasps[..., :3] @ Rt * scale + shift / POSITION_SCALE_M
    flip = torch.where(torch.rand(*grasps.shape[:2], 1) < 0.5 * symmetric, -1.0, 1.0)
    axes = [grasps[..., 3:6] @ Rt, grasps[..., 6:9] @ Rt * flip]
    return turned, torch.cat([position, *axes, grasps[..., 9:]], dim=-1)

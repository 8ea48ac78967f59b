"""The four operations of PointNet++ in plain PyTorch, for networks whose own are compiled for CUDA.

Written from their description (Qi et al. 2017) and from the edge cases of the compiled ones, so that released weights
get the inputs that they were trained on.
"""

from __future__ import annotations

import torch
from torch import Tensor

_AT_ORIGIN_SQUARED = 1e-3  # the compiled sampling skips points this near to the origin, which pad short clouds


def furthest_point_sampling(points: Tensor, count: int) -> Tensor:
    """Return indices (B, count) int32 of points (B, N, 3), each the furthest from those before; the first is point 0.

    Points within about 32 mm of the origin are skipped, as in the compiled operation; without any other, point 0 is
    repeated.
    """
    batch = torch.arange(len(points), device=points.device)
    near_origin = points.square().sum(dim=-1) <= _AT_ORIGIN_SQUARED
    gaps = torch.full(points.shape[:2], torch.inf, device=points.device)
    chosen = torch.zeros(len(points), count, dtype=torch.long, device=points.device)
    for step in range(1, count):
        last = points[batch, chosen[:, step - 1]]
        gaps = torch.minimum(gaps, (points - last[:, None]).square().sum(dim=-1))
        best, index = gaps.masked_fill(near_origin, -1.0).max(dim=1)
        chosen[:, step] = torch.where(best < 0.0, 0, index)
    return chosen.int()


def ball_query(centers: Tensor, points: Tensor, radius: float, count: int) -> Tensor:
    """Return indices (B, M, count) int32 of the first points (B, N, 3) nearer than `radius` to centers (B, M, 3).

    A ball that holds fewer repeats its first point; an empty one gives point 0.
    """
    total = points.shape[1]
    inside = (centers[:, :, None] - points[:, None]).square().sum(dim=-1) < radius * radius
    order = torch.where(inside, torch.arange(total, device=points.device), total)
    found = order.topk(min(count, total), largest=False, sorted=True).values
    first = torch.where(found[..., :1] == total, 0, found[..., :1])
    missing = first.expand(*found.shape[:2], count - found.shape[2])
    return torch.cat([torch.where(found == total, first, found), missing], dim=-1).int()


def gather_points(features: Tensor, index: Tensor) -> Tensor:
    """Return features (B, C, M) of (B, C, N) at index (B, M)."""
    return features.gather(2, index.long()[:, None].expand(-1, features.shape[1], -1))


def group_points(features: Tensor, index: Tensor) -> Tensor:
    """Return features (B, C, M, K) of (B, C, N) at index (B, M, K)."""
    return gather_points(features, index.flatten(1)).unflatten(2, index.shape[1:])

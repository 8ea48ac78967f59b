"""Shards of training data: procedural shapes, noisy single views, verified grasps."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from hal.base.files import atomic_path
from models.diffusion.cloud import prepare_cloud
from models.diffusion.training.dynamics_test import simulate_grasps
from models.diffusion.training.grippers import AnyGripper, ParallelGripperSpec
from models.diffusion.training.labels import check_grasps, find_grasps
from models.diffusion.training.shapes import FAMILY_WEIGHTS, make_shape
from models.diffusion.training.solids import Solid
from models.diffusion.training.views import ViewConfig, render_view

_MIN_GRASPS = 40  # shapes with fewer labels are dropped
_MAX_GRASPS = 384
_MAX_PARTS = 3  # of any family in `shapes`


def make_shard(
    gripper: AnyGripper, seed: int, n_shapes: int, n_views: int, view: ViewConfig | None = None
) -> dict[str, np.ndarray]:
    """Return one shard's arrays; S shapes, V = S × views.

    `clouds` (V, 512, 6) points and normals in the view frame, `T_view_object` (V, 4, 4), `shape` (V,) index of the
    shape, `family` (S,), `parts` and `profiles` (S, 3, …) the solids, `grasps` (S, 384, 4, 4) in the object frame with
    their widths (S, 384) [m], `n_grasps` (S,).
    """
    rng = np.random.default_rng(seed)
    families = list(FAMILY_WEIGHTS)
    rows: dict[str, list] = {k: [] for k in ("clouds", "T_view_object", "shape", "family", "parts", "profiles")}
    rows |= {k: [] for k in ("grasps", "widths_m", "n_grasps")}
    while len(rows["family"]) < n_shapes:
        solid = make_shape(str(rng.choice(families, p=list(FAMILY_WEIGHTS.values()))), rng)
        T, widths = find_grasps(solid, gripper, rng)
        if len(T) < _MIN_GRASPS:
            continue
        views = draw_views(solid, view or ViewConfig(), n_views, rng)
        for cloud, T_view_object in views:
            rows["clouds"].append(cloud)
            rows["T_view_object"].append(T_view_object)
            rows["shape"].append(len(rows["family"]))
        keep = rng.permutation(len(T))
        rows["n_grasps"].append(min(len(T), _MAX_GRASPS))
        # Repeated where a shape has fewer: all shapes share one array
        keep = np.resize(keep, _MAX_GRASPS)
        rows["grasps"].append(T[keep].astype(np.float32))
        rows["widths_m"].append(widths[keep].astype(np.float32))
        rows["family"].append(solid.family)
        rows["parts"].append(_pad_parts(solid.parts))
        rows["profiles"].append(_pad_parts(solid.profiles))
    return {key: np.array(values) for key, values in rows.items()}


def draw_views(
    solid: Solid, config: ViewConfig, count: int, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return `count` views of `solid`: cloud (512, 6) float16 in the view frame, and T_view_object (4, 4)."""
    views: list[tuple[np.ndarray, np.ndarray]] = []
    while len(views) < count:
        view = render_view(solid, config, rng)
        if view is None:
            continue
        points, T_camera_object = view
        cloud = prepare_cloud(points, rng)
        rows = np.concatenate([cloud.points, cloud.normals], axis=1).astype(np.float16)
        # The general inverse, as in all shards so far: its last bits differ from those of the rigid one.
        views.append((rows, (np.linalg.inv(cloud.T_camera_view) @ T_camera_object).astype(np.float32)))
    return views


def _pad_parts(rows: np.ndarray) -> np.ndarray:
    """Return `rows` filled up to the maximum number of parts; a repeated part does not change the union."""
    return np.concatenate([rows, np.repeat(rows[-1:], _MAX_PARTS - len(rows), axis=0)])


def save_shard(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a shard to `path` atomically."""
    with atomic_path(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def simulate_shard(arrays: dict[str, np.ndarray], gripper: ParallelGripperSpec, count: int) -> dict:
    """Return the numbers of simulated and of lost labels by family, `count` labels of each shape."""
    tried: Counter[str] = Counter()
    lost: Counter[str] = Counter()
    for family, parts, profiles, T, n in zip(
        *(arrays[key] for key in ("family", "parts", "profiles", "grasps", "n_grasps")), strict=True
    ):
        solid = Solid(family=str(family), parts=parts, profiles=profiles)
        labels = T[: min(count, n)].astype(np.float64)  # a shard's labels are in random order
        held = simulate_grasps(solid, labels, check_grasps(solid, labels, gripper), gripper)
        tried[solid.family] += len(held)
        lost[solid.family] += int((~held).sum())
    return {"tried": dict(tried), "lost": dict(+lost)}

"""Grasps swept over the faces of the object's box: no learning and no weights, so always available."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base.errors import InvalidValueError
from models.obb.mvbb import fit_obb
from models.obb.obb import FACE_AXES, DegenerateCloudError, OrientedBox
from models.samplers.gripper_models import choose_candidates, count_points
from models.types import GraspSet, check_object_cloud

_NEAR_FACE_M = 3e-3  # above the depth noise, 0.2 to 0.9 mm at 0.3 m
_GOLDEN = 1.0 / 1.2207440846057596 ** np.arange(1, 4)  # Roberts' R3 sequence: even in three numbers for any count
_MIN_SLICE_POINTS = 8
_SLICES = 25
_MAX_SIDE_SINE = 0.3  # a side whose normal leans from the camera by more than this sine is occluded


@dataclass(frozen=True, slots=True, kw_only=True)
class ObbSweepConfig:
    """Parallel gripper that is swept, and the range of the sweep."""

    max_width_m: float = 0.128
    """Widest object to close on [m]; a jaw of 136 mm keeps 4 mm on each side."""
    clearance_m: float = 0.005
    """Distance of each open finger from its contact [m]."""
    finger_length_m: float = 0.07
    """From the palm to the fingertips [m]."""
    finger_thickness_m: float = 0.012
    """Of one finger, along the opening [m]."""
    finger_width_m: float = 0.022
    """Of one finger, across the opening [m]."""
    min_depth_m: float = 0.012
    """Minimum reach of the fingertips behind the approached face [m]."""
    max_depth_m: float = 0.05
    """Maximum reach of the same [m]; less where the box is less deep."""
    past_widest_m: float = 0.006
    """Minimum reach of the fingertips past the widest place of a slice [m]."""
    max_tilt_rad: float = 0.35
    """Maximum tilt of the approach from the face's normal, about the closing axis [rad]."""
    slice_m: float = 0.012
    """Half the height of the slice of the cloud from which a grasp's width is measured [m]."""
    n_collision_points: int = 700
    """Points of the cloud against which candidates are tested."""
    oversampling: float = 2.0
    """Candidates tested for each grasp returned."""

    def __post_init__(self) -> None:
        if not 0.0 < self.min_depth_m <= self.max_depth_m < self.finger_length_m:
            raise InvalidValueError(
                f"obb_sweep: needs 0 < min_depth_m ≤ max_depth_m < finger_length_m; got {self.min_depth_m}, "
                f"{self.max_depth_m}, {self.finger_length_m}.",
                code="gripper_depth",
            )
        if self.max_width_m <= 0.0 or self.oversampling < 1.0 or not 0.0 <= self.max_tilt_rad < np.pi / 4:
            raise InvalidValueError(
                f"obb_sweep: needs max_width_m > 0, oversampling ≥ 1, 0 ≤ max_tilt_rad < π/4; got {self.max_width_m}, "
                f"{self.oversampling}, {self.max_tilt_rad}.",
                code="sampling",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sweep:
    """One approached face, and one of the two axes across it as the closing axis."""

    approach: np.ndarray  # (3,) into the face
    closing: np.ndarray  # (3,)
    along: np.ndarray  # (3,) the direction of the sweep
    half_width_m: float
    half_length_m: float
    half_depth_m: float
    low_side_visible: bool
    high_side_visible: bool
    weight: float


class ObbSweepSampler:
    """A `GraspGenerator` that closes across the box of a cloud, at all heights and depths, over its visible faces.

    Widths are those of the slice of the cloud between the jaws, so a bottle's neck is grasped at its own width. Faces
    turned from the camera are left out, and so is closing along an unobserved axis. Candidates that would hit visible
    points come last. Arm, table and gravity are not considered.
    """

    def __init__(self, config: ObbSweepConfig | None = None) -> None:
        self.config = config or ObbSweepConfig()

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m] seen from their origin, best score first.

        Raises:
            InvalidValueError: fewer than 30 points, points not finite or not in metres, or an object that is too
                wide for the gripper on all sides.
            DegenerateCloudError: all points on one line.
        """
        points = check_object_cloud(points, n)
        rng = np.random.default_rng(seed)
        box = fit_tightest_box(points)
        sweeps = self._find_sweeps(box)
        cloud = points[rng.permutation(len(points))[: self.config.n_collision_points]]
        counts = _apportion([sweep.weight for sweep in sweeps], int(np.ceil(n * self.config.oversampling)))
        drawn = [self._draw(s, count, box, cloud, rng) for s, count in zip(sweeps, counts, strict=True) if count]
        T, widths = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        hits, held = count_points(T, widths, cloud, self.config)
        scores = self._score(T, widths, hits, held, cloud)
        chosen = choose_candidates(scores, hits, n, rng)
        return GraspSet(T_camera_grasps=T[chosen], scores=scores[chosen], widths_m=widths[chosen], source="obb_sweep")

    def _find_sweeps(self, box: OrientedBox) -> list[_Sweep]:
        """Return the sweeps within the opening; faces towards the camera get more of the draws."""
        view = box.center_m / np.linalg.norm(box.center_m)
        sweeps = []
        for face, normal in enumerate(box.face_normals):
            towards = float(-normal @ view)
            if towards < -0.5:
                continue
            axis = int(FACE_AXES[face])
            for closing in sorted({0, 1, 2} - {axis}):
                half_width = float(box.half_extents_m[closing])
                if box.unobserved[closing] or 2.0 * half_width > self.config.max_width_m:
                    continue
                along = 3 - axis - closing
                sine = float(box.R_camera_box[:, closing] @ view)
                sweeps.append(
                    _Sweep(
                        approach=-normal,
                        closing=box.R_camera_box[:, closing],
                        along=box.R_camera_box[:, along],
                        half_width_m=half_width,
                        half_length_m=float(box.half_extents_m[along]),
                        half_depth_m=float(box.half_extents_m[axis]),
                        low_side_visible=sine > -_MAX_SIDE_SINE,
                        high_side_visible=sine < _MAX_SIDE_SINE,
                        weight=(0.3 + max(towards, 0.0)) * (0.5 + float(box.half_extents_m[along])),
                    )
                )
        if not sweeps:
            mm = " × ".join(f"{1e3 * extent:.0f}" for extent in box.extents_m)
            raise InvalidValueError(
                f"The object's box is {mm} mm; the gripper opens {1e3 * self.config.max_width_m:.0f} mm. Give a cloud "
                "of one object that is narrower on some visible side.",
                code="no_grasps",
            )
        return sweeps

    def _draw(
        self, sweep: _Sweep, count: int, box: OrientedBox, cloud: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `count` poses (K, 4, 4) spread evenly over the face, depth and tilt, and their widths (K,) [m]."""
        config = self.config
        u = (rng.random(3) + np.arange(1, count + 1)[:, None] * _GOLDEN) % 1.0
        reach = max(sweep.half_length_m - 0.25 * config.finger_width_m, 0.3 * sweep.half_length_m)
        s = (2.0 * u[:, 0] - 1.0) * reach
        deepest = float(np.clip(2.0 * sweep.half_depth_m, config.min_depth_m, config.max_depth_m))
        depth = config.min_depth_m + u[:, 1] * (deepest - config.min_depth_m) - sweep.half_depth_m
        tilt = (2.0 * u[:, 2] - 1.0) * config.max_tilt_rad
        places = np.linspace(-reach, reach, _SLICES)
        low, high, widest = self._measure_slices(sweep, places, cloud - box.center_m)
        nearest = np.round((s + reach) / (2.0 * reach) * (_SLICES - 1)).astype(int)
        low, high = low[nearest], high[nearest]
        depth = np.maximum(depth, widest[nearest] + config.past_widest_m)
        approach = np.cos(tilt)[:, None] * sweep.approach + np.sin(tilt)[:, None] * sweep.along
        closing = np.broadcast_to(sweep.closing, approach.shape)
        T = np.tile(np.eye(4), (count, 1, 1))
        T[:, :3, :3] = np.stack([np.cross(closing, approach), closing, approach], axis=2)
        middle = (
            s[:, None] * sweep.along + depth[:, None] * sweep.approach + (low + high)[:, None] / 2.0 * sweep.closing
        )
        T[:, :3, 3] = box.center_m + middle
        return T, np.clip(high - low, 0.002, config.max_width_m)

    def _measure_slices(
        self, sweep: _Sweep, places: np.ndarray, cloud: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return both ends (S,) of slices at `places` (S,) along the closing axis, and their depth (S,) [m].

        Fingertips go past the widest place of a round slice: before it they would slip off. Where a slice holds too
        few points, or its far end is occluded, the box's own ends are used. `cloud` (M, 3) is relative to its centre.
        """
        config = self.config
        along, deep, across = (cloud @ axis for axis in (sweep.along, sweep.approach, sweep.closing))
        between = np.abs(along - places[:, None]) < config.slice_m
        # Points deeper than the fingertips reach are not between the jaws
        between &= deep < config.max_depth_m - sweep.half_depth_m
        measured = between.sum(axis=1) >= _MIN_SLICE_POINTS
        lowest = np.where(between, across, np.inf).min(axis=1)
        highest = np.where(between, across, -np.inf).max(axis=1)
        low = np.where(measured & sweep.low_side_visible, lowest, -sweep.half_width_m)
        high = np.where(measured & sweep.high_side_visible, highest, sweep.half_width_m)
        at_ends = [between & (np.abs(across - end[:, None]) < _NEAR_FACE_M) for end in (low, high)]
        widest = np.max([_masked_min(deep, at_end) for at_end in at_ends], axis=0)
        return low, high, widest

    def _score(
        self, T: np.ndarray, widths: np.ndarray, hits: np.ndarray, held: np.ndarray, cloud: np.ndarray
    ) -> np.ndarray:
        """Return scores (H,) in [0, 1] from distance to the centroid, width, points between the pads and hits."""
        middle = cloud.mean(axis=0)
        spread = np.sqrt(np.mean(np.sum((cloud - middle) ** 2, axis=1)))
        off_line = np.cross(T[:, :3, 3] - middle, T[:, :3, 2])  # distance of the approach line from the centroid
        offset = np.linalg.norm(off_line, axis=1) / spread
        support = held / (held + 0.02 * len(cloud))
        narrow = 1.0 - widths / self.config.max_width_m
        return (0.4 * np.exp(-0.5 * offset**2) + 0.2 * narrow + 0.4 * support) / (1.0 + hits)


def fit_tightest_box(points: np.ndarray) -> OrientedBox:
    """Return the box of `points` (N, 3) [m] that has most of them on its faces.

    The minimum-volume box follows the hypotenuse where only two side faces are visible (15 to 30° off). One of its
    axes is still right then, the one both faces share; so each is tried as the upright axis of a box that follows
    visible sides.

    Raises:
        DegenerateCloudError: the points are all on one line or in one place.
    """
    smallest = fit_obb(points, "min_volume")
    boxes = [smallest]
    for axis in smallest.R_camera_box.T:
        try:
            boxes.append(fit_obb(points, "upright", up=axis))
        except DegenerateCloudError:
            continue
    return max(boxes, key=lambda box: _ratio_on_faces(points, box))


def _ratio_on_faces(points: np.ndarray, box: OrientedBox) -> float:
    """Return the ratio of points within 3 mm of a face towards the camera."""
    facing = np.sum(box.face_normals * box.face_centers_m, axis=1) < 0.0
    heights = (points @ box.face_normals.T - np.sum(box.face_normals * box.face_centers_m, axis=1))[:, facing]
    return float((np.abs(heights) < _NEAR_FACE_M).any(axis=1).mean())


def _apportion(weights: list[float], total: int) -> np.ndarray:
    """Return whole numbers proportional to `weights` that add up to `total`."""
    bounds = np.round(np.cumsum(weights) / np.sum(weights) * total).astype(int)
    return np.diff(bounds, prepend=0)


def _masked_min(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the minimum of `values` (M,) in each row of `mask` (S, M); −inf for an empty row."""
    return np.where(mask.any(axis=1), np.where(mask, values, np.inf).min(axis=1), -np.inf)

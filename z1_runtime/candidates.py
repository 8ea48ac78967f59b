"""Ranked grasps laid out for the beak: measured, fitted and tested at the grasp, all before any joint is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.types import GraspSet
from z1_runtime.arm_collision import Problem
from z1_runtime.collision import CollisionChecker
from z1_runtime.gripper import BeakBatch, BeakGripper

_CHUNK = 48
_MAX_SHAPE_POINTS = 1500
_PALM_HALF_WIDTH_M = 0.041


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Way:
    """One candidate, one flip: all the motion needs to know."""

    T_base_pivot: np.ndarray
    """(4, 4) at the grasp."""
    T_base_grasp: np.ndarray
    """(4, 4)."""
    jaw_open: float
    """[rad]"""
    T_base_touch: np.ndarray
    """(4, 4) pivot pose to which the hand turns while the jaw closes."""
    jaw_touch: float
    """Mover angle there [rad]."""


class Candidates:
    """All candidates in the base frame, fitted and pre-checked chunk by chunk, so that an early hit comes fast."""

    def __init__(
        self,
        ranked: GraspSet,
        T_base_camera: np.ndarray,
        gripper: BeakGripper,
        checker: CollisionChecker,
        *,
        fallback_width_m: float,
    ) -> None:
        """Take `ranked` (camera frame); `fallback_width_m` stands for widths that nothing tells [m]."""
        self._gripper = gripper
        self._checker = checker
        self._fallback_width_m = fallback_width_m
        self._T_base_grasps = T_base_camera @ ranked.T_camera_grasps
        points = checker.object_points
        self._shape_points = points[:: max(1, len(points) // _MAX_SHAPE_POINTS)]
        self.widths_m = np.array(ranked.widths_m, dtype=np.float64)
        """(N,) as given, or measured in the cloud once the candidate was fitted [m]."""
        self._fronts_m = np.full(len(ranked), np.nan)
        self._chunks: dict[int, tuple[BeakBatch, list[list[Problem | None]]]] = {}

    def __len__(self) -> int:
        return len(self.widths_m)

    def jaw_contact(self, rank: int) -> float:
        """Return the mover angle at which candidate `rank` is touched [rad]."""
        return float(self._chunks[rank // _CHUNK][0].jaw_contact[rank % _CHUNK])

    def free(self) -> np.ndarray:
        """Return (N,) whether a flip of each candidate hits nothing at the grasp."""
        return np.array([not isinstance(self.ways(rank), Problem) for rank in range(len(self))], dtype=bool)

    def ways(self, rank: int) -> list[Way] | Problem:
        """Return the flips of candidate `rank` that hit nothing at the grasp, or why there is none."""
        if rank // _CHUNK not in self._chunks:
            self._fit_chunk(rank // _CHUNK)
        batch, problems = self._chunks[rank // _CHUNK]
        n = rank % _CHUNK
        under = [problem for problem in problems[n] if problem is not None and problem.reason == "table"]
        if len(under) == len(problems[n]):
            return under[0]
        if not batch.fits[n]:
            return Problem(
                reason="width", detail=self._gripper.refusal(float(self.widths_m[rank]), float(self._fronts_m[rank]))
            )
        T_base_grasp = self._T_base_grasps[rank]
        # The pivot's +y carries the camera: above the hand it is clear of the table and sees the object
        camera_up_first = (0, 1) if T_base_grasp[2, 0] >= 0.0 else (1, 0)
        free = [flip for flip in camera_up_first if problems[n][flip] is None]
        if not free:
            problem = problems[n][camera_up_first[0]]
            assert problem is not None
            return problem
        return [
            Way(
                T_base_pivot=batch.T_base_pivots[n, flip],
                T_base_grasp=T_base_grasp,
                jaw_open=float(batch.jaw_open[n]),
                T_base_touch=batch.T_base_touches[n, flip],
                jaw_touch=float(batch.jaw_touch[n]),
            )
            for flip in free
        ]

    def _fit_chunk(self, chunk: int) -> None:
        part = slice(chunk * _CHUNK, (chunk + 1) * _CHUNK)
        T_base_grasps = self._T_base_grasps[part]
        self._measure(part)
        batch = self._gripper.fit_batch(T_base_grasps, self.widths_m[part], self._fronts_m[part])
        pivots, jaws = batch.T_base_pivots.reshape(-1, 4, 4), np.repeat(batch.jaw_open, 2)
        hits = self._checker.check_grippers(pivots, jaws)
        problems = [[hits.problem(2 * n + flip) for flip in range(2)] for n in range(len(T_base_grasps))]
        self._chunks[chunk] = batch, problems

    def _measure(self, part: slice) -> None:
        """Fill in widths nobody gave, and how far the object reaches towards the palm, from the object's points."""
        depth_m = self._gripper.config.contact_depth_m
        for rank in range(*part.indices(len(self.widths_m))):
            T = self._T_base_grasps[rank]
            x, y, z = ((self._shape_points - T[:3, 3]) @ T[:3, :3]).T
            between = np.abs(x) < _PALM_HALF_WIDTH_M
            if not np.isfinite(self.widths_m[rank]):
                beside_pads = between & (np.abs(z + depth_m) < 0.025) & (np.abs(y) < 0.06)
                seen_m = float(2.0 * np.abs(y[beside_pads]).max()) if beside_pads.any() else np.nan
                self.widths_m[rank] = seen_m if np.isfinite(seen_m) else self._fallback_width_m
            between &= np.abs(y) < 0.5 * self.widths_m[rank] + 0.005
            # A percentile, not the nearest point: one speckle would push the whole hand back
            front_m = -np.percentile(z[between], 1.0) - depth_m if between.any() else 0.0
            self._fronts_m[rank] = max(front_m, 0.0)

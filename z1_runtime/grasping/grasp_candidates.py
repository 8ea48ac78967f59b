"""Ranked grasps laid out for the beak: measured, fitted and tested at the grasp, all before any joint is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.types import GraspSet
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.collision.self_collision import Problem
from z1_runtime.grasping.beak_gripper import BeakBatch, BeakGripper
from z1_runtime.grasping.width_estimation import fit_grasps, make_room, measure_support

_CHUNK = 48
_MAX_SHAPE_POINTS = 1000
_ELSEWHERE_M = 0.003


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GripperPlacement:
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


class GraspCandidates:
    """All candidates in the base frame, fitted and pre-checked chunk by chunk, so that an early hit comes fast."""

    def __init__(
        self,
        ranked: GraspSet,
        T_base_camera: np.ndarray,
        gripper: BeakGripper,
        checker: CollisionChecker,
        *,
        fallback_width_m: float,
        chunk: int = _CHUNK,
    ) -> None:
        """Take `ranked` (camera frame).

        Args:
            ranked: in the order in which they are asked for.
            T_base_camera: (4, 4).
            gripper: what is laid around the object.
            checker: what it may hit.
            fallback_width_m: stands for widths that nothing tells [m].
            chunk: how many are fitted at once; all of them, where all will be asked for.
        """
        self._chunk = max(1, chunk)
        self._gripper = gripper
        self._checker = checker
        self._fallback_width_m = fallback_width_m
        self._T_base_grasps = T_base_camera @ ranked.T_camera_grasps
        points = checker.object_points
        self._shape_points = points[:: max(1, len(points) // _MAX_SHAPE_POINTS)]
        self.widths_m = np.array(ranked.widths_m, dtype=np.float64)
        """(N,) as given, or measured in the cloud once the candidate was fitted [m]."""
        self.support = np.full(len(ranked), np.nan)
        """(N,) share of the pads that what is seen of the object fills, in [0, 1], once the candidate was fitted."""
        self.level = np.full(len(ranked), np.nan)
        """(N,) 1 where the jaws' push is level, 0 where friction just holds, once the candidate was fitted."""
        self._fronts_m = np.full(len(ranked), np.nan)
        self._chunks: dict[int, tuple[BeakBatch, list[list[Problem | None]]]] = {}

    def __len__(self) -> int:
        return len(self.widths_m)

    @property
    def contacts(self) -> np.ndarray:
        """(N, 3) the middle between the contacts, in the base frame [m]."""
        depth_m = self._gripper.config.contact_depth_m
        return self._T_base_grasps[:, :3, 3] - depth_m * self._T_base_grasps[:, :3, 2]

    def jaw_contact(self, rank: int) -> float:
        """Return the mover angle at which candidate `rank` is touched [rad]."""
        return float(self._chunks[rank // self._chunk][0].jaw_contact[rank % self._chunk])

    def free(self) -> np.ndarray:
        """Return (N,) whether a flip of each candidate hits nothing at the grasp."""
        return np.array([not isinstance(self.ways(rank), Problem) for rank in range(len(self))], dtype=bool)

    def ways(self, rank: int) -> list[GripperPlacement] | Problem:
        """Return the flips of candidate `rank` that hit nothing at the grasp, or why there is none."""
        chunk, n = divmod(rank, self._chunk)
        if chunk not in self._chunks:
            self._fit_chunk(chunk)
        batch, problems = self._chunks[chunk]
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
            GripperPlacement(
                T_base_pivot=batch.T_base_pivots[n, flip],
                T_base_grasp=T_base_grasp,
                jaw_open=float(batch.jaw_open[n]),
                T_base_touch=batch.T_base_touches[n, flip],
                jaw_touch=float(batch.jaw_touch[n]),
            )
            for flip in free
        ]

    def _fit_chunk(self, chunk: int) -> None:
        part = slice(chunk * self._chunk, (chunk + 1) * self._chunk)
        T_base_grasps = self._measure(part)
        batch = self._gripper.fit_batch(T_base_grasps, self.widths_m[part], self._fronts_m[part])
        self.level[part] = batch.level
        pivots, jaws = batch.T_base_pivots.reshape(-1, 4, 4), np.repeat(batch.jaw_open, 2)
        hits = self._checker.check_grippers(pivots, jaws)
        problems = [[hits.problem(2 * n + flip) for flip in range(2)] for n in range(len(T_base_grasps))]
        self._chunks[chunk] = batch, problems

    def _measure(self, part: slice) -> np.ndarray:
        """Fill in what the object's points say of the grasps in `part`; return them (n, 4, 4), moved to the middle of
        the object and on along their approach, with room for what is hidden.

        Where jaws and palm cannot hold the object where it was asked, it is measured again where they can.
        """
        Ts, given = self._T_base_grasps[part], self.widths_m[part].copy()
        T_base_grasps, widths, fronts = self._middled(Ts, given)
        deeper, setback = self._along(T_base_grasps, widths, fronts)
        away = deeper - setback
        moved = np.abs(away) > _ELSEWHERE_M
        if moved.any():
            there, widths[moved], _ = self._middled(_advanced(Ts[moved], away[moved]), given[moved])
            T_base_grasps[moved] = _advanced(there, -away[moved])
        self.widths_m[part], self._fronts_m[part] = widths, fronts + deeper
        self.support[part] = measure_support(
            _advanced(T_base_grasps, away), widths, self._shape_points, self._gripper.config.contact_depth_m
        )
        return _advanced(T_base_grasps, deeper)

    def _middled(self, Ts: np.ndarray, given_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return grasps (n, 4, 4) moved along y to the middle of what is between their pads, its width (n,), and how
        far it reaches towards the palm (n,) [m]; widths `given_m` (n,) may be NaN."""
        beak = self._gripper.config
        fit = fit_grasps(Ts, given_m, self._shape_points, beak.contact_depth_m, beak.unseen_m)
        widths = np.where(np.isfinite(fit.widths_m), fit.widths_m, self._fallback_width_m)
        middled = Ts.copy()
        middled[:, :3, 3] += fit.shifts_m[:, None] * Ts[:, :3, 1]
        return *make_room(middled, widths, self._checker.occluded_points, beak.contact_depth_m), fit.fronts_m

    def _along(self, Ts: np.ndarray, widths_m: np.ndarray, fronts_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far (n,) grasps move on along their approach, to where the object is as wide as it gets, and how
        far (n,) they are set back for the palm's sake [m].

        A round object reaches half its width towards the palm; where less of it is seen, the contacts lie before its
        middle, and the jaws would push it out. The table bounds how far the jaws can go.
        """
        batch = self._gripper.fit_batch(Ts, widths_m, fronts_m)
        spare = self._checker.spare_height_m(batch.T_base_pivots.reshape(-1, 4, 4), np.repeat(batch.jaw_open, 2))
        down = np.maximum(-Ts[:, :3, 2] @ self._checker.table.normal, 1e-3)
        room = spare.reshape(-1, 2).max(axis=1) / down
        most = np.minimum(self._gripper.config.max_deepening_m, np.maximum(room, 0.0))
        return np.clip(0.5 * widths_m - fronts_m, 0.0, most), batch.setback_m


def _advanced(Ts: np.ndarray, by_m: np.ndarray) -> np.ndarray:
    """Return grasps (n, 4, 4) moved along their approach by `by_m` (n,) [m]."""
    moved = Ts.copy()
    moved[:, :3, 3] += by_m[:, None] * Ts[:, :3, 2]
    return moved

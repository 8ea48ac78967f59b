"""Orders grasps by what this arm and this gripper can do with them, not by what they are worth to any hand.

Three steps, each dearer than the one before and asked of fewer: is there room for the beak, how well would it hold, and
can the arm go there. How well it would hold is a weighted sum of terms in [0, 1] whose weights are set by hand, or a
probability that a fitted head gives.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hal.base import z1
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.collision.self_collision import Problem
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.grasp_candidates import GraspCandidates, GripperPlacement
from z1_runtime.planning.planner_config import PlannerConfig

_EASY_MARGIN_RAD = 0.25
_EASY_SINGULAR_VALUE = 0.12
_APPROACH_SHARES = np.array([1.0, 0.6, 0.25, 0.0])  # of the stand-off
_WITHIN_REACH, _FREE, _REFUSED = 2.0, 1.0, 0.0


class ReachabilityRanker:
    """Scores candidates for one arm among the surroundings of one frame."""

    def __init__(
        self, kinematics: Kinematics, checker: CollisionChecker, candidates: GraspCandidates, config: PlannerConfig
    ) -> None:
        self._kinematics = kinematics
        self._checker = checker
        self._candidates = candidates
        self._planner = config
        self._config = config.ability

    def scores(
        self,
        middle: np.ndarray,
        generator: np.ndarray,
        alignments: np.ndarray,
        *,
        likely: np.ndarray | None = None,
        wanted: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return what each candidate is worth, (N,).

        The whole part says how far it was followed: 2 the arm reaches it, 1 there is room for the beak (and the arm
        was not asked, or does not reach it: then it counts half), 0 there is none. The rest is its quality in [0, 1).

        Args:
            middle: (3,) of the object, in the base frame [m].
            generator: (N,) scores in [0, 1].
            alignments: (N,) with the box, in [0, 1].
            likely: (N,) probabilities that stand for the weighted sum.
            wanted: (N,) bool; the quality of the others counts a thousandth, so that they are asked last.
        """
        ways = [self._candidates.ways(rank) for rank in range(len(self._candidates))]
        free = np.array([not isinstance(way, Problem) for way in ways], dtype=bool)
        if likely is None:
            quality = 0.999 * self.quality(middle, generator, alignments)
        else:
            quality = 0.999 * (1.0 - self._config.ease) * likely
        if wanted is not None:
            quality = np.where(wanted, quality, 1e-3 * quality)
        scores = np.where(free, _FREE, _REFUSED) + quality
        reached = 0
        order = np.argsort(-quality, kind="stable")
        for rank in order[free[order]][: self._config.n_asked]:
            found = ways[rank]
            assert not isinstance(found, Problem)
            ease = max((self.ease(way) for way in found), default=0.0)
            scores[rank] = _WITHIN_REACH + quality[rank] + 0.999 * self._config.ease * ease if ease else quality[rank]
            reached += ease > 0.0
            if reached == self._config.n_reached:
                break
        return scores

    def quality(self, middle: np.ndarray, generator: np.ndarray, alignments: np.ndarray) -> np.ndarray:
        """Return how well each grasp would hold, (N,), in [0, 1 - the weight of `ease`]; arguments as in `scores`."""
        config, candidates = self._config, self._candidates
        away = np.linalg.norm(candidates.contacts - middle, axis=1) / config.centring_m
        return (
            config.centring * np.exp(-0.5 * away**2)
            + config.support * candidates.support
            + config.level * candidates.level
            + config.generator * np.clip(generator, 0.0, 1.0)
            + config.box * np.clip(np.nan_to_num(alignments), 0.0, 1.0)
        )

    def ease(self, way: GripperPlacement) -> float:
        """Return how easily the arm goes `way`, in (0, 1]; 0 if it cannot."""
        for standoff_m in dict.fromkeys((self._planner.standoff_m, self._planner.short_standoff_m)):
            ease = max((self._posture_ease(qs) for qs in self._chains(way, standoff_m)), default=0.0)
            if ease and self._approach_is_free(way, standoff_m):
                return ease
        return 0.0

    def _chains(self, way: GripperPlacement, standoff_m: float) -> Iterator[np.ndarray]:
        """Yield arm joints (3, 6) before, at and after the grasp, on one branch each."""
        T_pre, T_lifted = way.T_base_pivot.copy(), way.T_base_touch.copy()
        T_pre[:3, 3] -= standoff_m * way.T_base_grasp[:3, 2]
        T_lifted[2, 3] += self._planner.lift_m
        before = self._kinematics.solve(T_pre)
        at = self._kinematics.solve(way.T_base_pivot) if before else []
        after = self._kinematics.solve(T_lifted) if at else []
        if not after:
            return
        for q in before:
            chain = [q]
            for branches in (at, after):
                chain.append(min(branches, key=lambda branch, q=chain[-1]: float(np.abs(branch - q).max())))
            qs = np.array(chain)
            if np.abs(np.diff(qs, axis=0)).max() < self._planner.max_swing_rad:
                yield qs

    def _posture_ease(self, qs: np.ndarray) -> float:
        """Return how far joints (K, 6) are from limits and from a singular posture, in (0, 1]; 0 where they collide."""
        jaw = [z1.GRIPPER_CLOSED]
        if any(self._checker.check_posture(np.append(q, jaw)) is not None for q in qs[:2]):
            return 0.0
        margin = np.minimum(qs - z1.Q_MIN[: z1.N_ARM], z1.Q_MAX[: z1.N_ARM] - qs).min() / _EASY_MARGIN_RAD
        least = np.linalg.svd(self._kinematics.jacobian(qs[1]), compute_uv=False)[-1] / _EASY_SINGULAR_VALUE
        return float(np.clip(0.5 * min(margin, 1.0) + 0.5 * min(least, 1.0), 0.01, 1.0))

    def _approach_is_free(self, way: GripperPlacement, standoff_m: float) -> bool:
        T = np.tile(way.T_base_pivot, (len(_APPROACH_SHARES), 1, 1))
        T[:, :3, 3] -= standoff_m * _APPROACH_SHARES[:, None] * way.T_base_grasp[:3, 2]
        return bool(self._checker.check_grippers(T, np.full(len(T), way.jaw_open)).free().all())

"""Ranking of grasps by what this arm and this gripper can do with them.

Three steps, each more expensive than the one before and done for fewer: is the gripper free at the grasp, how well
would it hold, and can the arm reach it. How well it would hold is a weighted sum of terms in [0, 1], with configured
weights, or a probability that a fitted head gives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from models.obb.mvbb import RankedGrasps
from models.obb.obb import OrientedBox
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.grasping.beak_gripper import GripperPlacement
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.grasping.ranking import Ranking, measure_features, object_centre_from_table
from z1_runtime.planning.config import PlannerConfig

_FULL_MARGIN_RAD = 0.25  # from the nearest joint limit; more counts no more
_FULL_SINGULAR_VALUE = 0.12  # of the Jacobian, its smallest; more counts no more
_MIN_MANIPULABILITY = 0.01  # of a feasible posture, as 0 means that there is none
_APPROACH_RATIOS = np.array([1.0, 0.6, 0.25, 0.0])  # of the stand-off
_REACHED, _FREE, _BLOCKED = 2.0, 1.0, 0.0
_BELOW_ONE = 0.999  # keeps a quality from reaching the next whole score
_BELOW_THRESHOLD = 1e-3  # factor that puts grasps below a threshold after all others


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RankedCandidates:
    """Grasps in the order in which to try them, and the same grasps fitted to the gripper."""

    ranked: RankedGrasps
    candidates: GraspCandidates
    success_probability: np.ndarray | None = None
    """(N,) of each, by the fitted head of the ranking; None without one."""


class ReachabilityRanker:
    """Ranks candidates for one arm in one scene."""

    def __init__(self, kinematics: Kinematics, checker: CollisionChecker, config: PlannerConfig) -> None:
        self._kinematics = kinematics
        self._checker = checker
        self._planner = config
        self._config = config.reachability

    def rank(
        self, ranked: RankedGrasps, candidates: GraspCandidates, ranking: Ranking | None = None
    ) -> RankedCandidates:
        """Return the same grasps, most promising first.

        Args:
            ranked: grasps that the box let pass, with that box.
            candidates: the same, in the same order.
            ranking: whose head and thresholds count; None has neither.

        Raises:
            DegenerateCloudError: the head needs an upright box, and the object's cloud spans none.
        """
        if ranked.box is None:
            raise InvalidValueError("ReachabilityRanker: the grasps were ranked without a box.", code="no_box")
        probability = None
        if ranking is not None and ranking.head is not None:
            probability = ranking.head.probability(measure_features(candidates))
        scores = self.scores(candidates, ranked.box, ranked.alignments, ranking, probability)
        order = np.argsort(-scores, kind="stable")  # as `RankedGrasps.reordered` sorts
        return RankedCandidates(
            ranked=ranked.reordered(scores),
            candidates=candidates.reordered(order),
            success_probability=None if probability is None else probability[order],
        )

    def scores(
        self,
        candidates: GraspCandidates,
        box: OrientedBox,
        alignments: np.ndarray,
        ranking: Ranking | None = None,
        success_probability: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the score of each candidate, (N,).

        The whole part is how far it was followed: 2 the arm reaches it, 1 the gripper is free there (and the arm was
        not checked, or does not reach it: then 0), 0 it is blocked. The rest is its quality in [0, 1).

        Args:
            candidates: fitted here, as far as they are not yet.
            box: of the object, in the camera frame.
            alignments: (N,) with the box, in [0, 1].
            ranking: whose thresholds count; None has none.
            success_probability: (N,) by a fitted head, in place of the configured weights.
        """
        placements = [candidates.placements(rank) for rank in range(len(candidates))]
        free = np.array([each.rejection is None for each in placements], dtype=bool)
        quality = self._expected_quality(candidates, box, alignments, success_probability)
        if ranking is not None:
            passes = ranking.passes_thresholds(alignments, candidates.grasps.scores)
            quality = np.where(passes, quality, _BELOW_THRESHOLD * quality)
        scores = np.where(free, _FREE, _BLOCKED) + quality
        n_reached = 0
        order = np.argsort(-quality, kind="stable")
        for rank in order[free[order]][: self._config.n_asked]:
            manipulability = max((self.manipulability(each) for each in placements[rank].placements), default=0.0)
            scores[rank] = quality[rank]
            if manipulability:
                scores[rank] = _REACHED + quality[rank] + _BELOW_ONE * self._config.manipulability * manipulability
                n_reached += 1
            if n_reached == self._config.n_reached:
                break
        return scores

    def _expected_quality(
        self,
        candidates: GraspCandidates,
        box: OrientedBox,
        alignments: np.ndarray,
        success_probability: np.ndarray | None,
    ) -> np.ndarray:
        """Return the part of the scores that does not depend on the arm, (N,), in [0, 1)."""
        if success_probability is not None:
            return _BELOW_ONE * (1.0 - self._config.manipulability) * success_probability
        centre = object_centre_from_table(box, candidates.scene)
        return _BELOW_ONE * self.quality(candidates, centre, alignments)

    def quality(self, candidates: GraspCandidates, centre: np.ndarray, alignments: np.ndarray) -> np.ndarray:
        """Return how well each grasp would hold, (N,), in [0, 1 - the weight of `manipulability`].

        Args:
            candidates: fitted here, as far as they are not yet.
            centre: (3,) of the object, in the base frame [m].
            alignments: (N,) with the box, in [0, 1].
        """
        config = self._config
        distance = np.linalg.norm(candidates.contacts - centre, axis=1) / config.centring_m
        return (
            # 0.61 at one `centring_m` from the centre
            config.centring * np.exp(-0.5 * distance**2)
            + config.support * candidates.support
            + config.level * candidates.level
            + config.generator * np.clip(candidates.grasps.scores, 0.0, 1.0)
            + config.box * np.clip(np.nan_to_num(alignments), 0.0, 1.0)
        )

    def manipulability(self, placement: GripperPlacement) -> float:
        """Return the manipulability score of `placement`, in (0, 1]; 0 if the arm cannot reach it."""
        for standoff_m in dict.fromkeys((self._planner.standoff_m, self._planner.short_standoff_m)):
            score = max((self._posture_score(qs) for qs in self._chains(placement, standoff_m)), default=0.0)
            if score and self._is_approach_free(placement, standoff_m):
                return score
        return 0.0

    def _chains(self, placement: GripperPlacement, standoff_m: float) -> Iterator[np.ndarray]:
        """Yield arm joints (3, 6) before, at and after the grasp, on one branch each."""
        T_pre, T_lifted = placement.T_base_pivot.copy(), placement.T_base_touch.copy()
        T_pre[:3, 3] -= standoff_m * placement.T_base_grasp[:3, 2]
        T_lifted[2, 3] += self._planner.lift_m
        before = self._kinematics.solve(T_pre)
        at = self._kinematics.solve(placement.T_base_pivot) if before else []
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

    def _posture_score(self, qs: np.ndarray) -> float:
        """Return the distance of joints (K, 6) from limits and singular postures, in (0, 1]; 0 where they collide."""
        jaw = [z1.GRIPPER_CLOSED]
        if any(self._checker.check_posture(np.append(q, jaw)) is not None for q in qs[:2]):
            return 0.0
        margin = np.minimum(qs - z1.Q_MIN[: z1.N_ARM], z1.Q_MAX[: z1.N_ARM] - qs).min() / _FULL_MARGIN_RAD
        singular = np.linalg.svd(self._kinematics.jacobian(qs[1]), compute_uv=False)[-1] / _FULL_SINGULAR_VALUE
        return float(np.clip(0.5 * min(margin, 1.0) + 0.5 * min(singular, 1.0), _MIN_MANIPULABILITY, 1.0))

    def _is_approach_free(self, placement: GripperPlacement, standoff_m: float) -> bool:
        T = np.tile(placement.T_base_pivot, (len(_APPROACH_RATIOS), 1, 1))
        T[:, :3, 3] -= standoff_m * _APPROACH_RATIOS[:, None] * placement.T_base_grasp[:3, 2]
        return bool(self._checker.check_grippers(T, np.full(len(T), placement.jaw_open)).free().all())

"""Union of grasp generators: all their grasps scored by one discriminator, the best kept."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from hal.base.errors import InvalidValueError
from models.types import GraspGenerator, GraspSet, check_object_cloud

_LOG = logging.getLogger(__name__)
_SAME_PLACE_M = 3e-3
_SAME_DIRECTION_RAD = np.deg2rad(8.0)


class Scorer(Protocol):
    """Scorer of grasps, independent of their generator."""

    def score(self, points: np.ndarray, grasps: GraspSet, seed: int) -> np.ndarray:
        """Return scores (N,) in [0, 1] of `grasps` on the object's `points` (M, 3) [m]."""
        ...


class UnionSampler:
    """A `GraspGenerator` that combines several and keeps the best of their grasps.

    Each member samples all `n` grasps, so that no member makes the union worse; the cost is the sum of theirs and the
    scoring. Of grasps that are nearly the same (3 mm, 8°, both closing directions alike) only the best counts. The
    scores alone decide the mix of members. A member without grasps on a cloud is skipped as long as another has some.
    """

    def __init__(self, members: Sequence[GraspGenerator], scorer: Scorer | None = None) -> None:
        """Store the members; without a scorer the discriminator of the shipped weights is loaded.

        Raises:
            InvalidValueError: fewer than two members.
            WeightsError: the discriminator's weights are missing or damaged.
        """
        if len(members) < 2:
            raise InvalidValueError(
                f"union: {len(members)} generator given, allowed is two or more.", code="union_members"
            )
        if scorer is None:
            # Imported here: it loads torch, which a given scorer may not need
            from models.diffusion.scorer import GraspScorer

            scorer = GraspScorer()
        self.members = tuple(members)
        self._scorer = scorer

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return the best `n` of the members' grasps for `points` (M, 3) [m], best score first.

        Where thinning leaves fewer than `n`, the best duplicates fill up.

        Raises:
            InvalidValueError: as `check_object_cloud`.
            ValueError: no member finds any grasp; the first one's error.
        """
        points = check_object_cloud(points, n)
        found = self._sample_members(points, n, seed)
        T = np.concatenate([grasps.T_camera_grasps for grasps in found])
        widths = np.concatenate([grasps.widths_m for grasps in found])
        source = "union:" + "+".join(grasps.source for grasps in found)
        # The members' own scores are not comparable, so all are scored by one discriminator
        proposed = GraspSet(T_camera_grasps=T, scores=np.zeros(len(T)), widths_m=widths, source=source)
        scores = self._scorer.score(points, proposed, seed)
        order = np.argsort(-scores, kind="stable")
        duplicates = find_duplicates(T[order])
        chosen = np.concatenate([order[~duplicates], order[duplicates]])[:n]
        chosen = chosen[np.argsort(-scores[chosen], kind="stable")]
        return GraspSet(T_camera_grasps=T[chosen], scores=scores[chosen], widths_m=widths[chosen], source=source)

    def _sample_members(self, points: np.ndarray, n: int, seed: int) -> list[GraspSet]:
        found, failures = [], []
        for member in self.members:
            try:
                found.append(member.sample(points, n, seed))
            except ValueError as err:
                failures.append(err)
        if not found:
            raise failures[0]
        for failure in failures:
            _LOG.info("a member of the union found no grasps: %s", failure)
        return found


def find_duplicates(T: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of poses `T` (N, 4, 4), best first, that nearly equal a better one that is kept."""
    near = KDTree(T[:, :3, 3]).query_pairs(_SAME_PLACE_M, output_type="ndarray")
    near = np.sort(near, axis=1)
    first, second = near[:, 0], near[:, 1]
    approach = np.sum(T[first, :3, 2] * T[second, :3, 2], axis=1)
    # A parallel gripper is the same with its fingers exchanged
    closing = np.abs(np.sum(T[first, :3, 1] * T[second, :3, 1], axis=1))
    same = (approach > np.cos(_SAME_DIRECTION_RAD)) & (closing > np.cos(_SAME_DIRECTION_RAD))
    duplicates = np.zeros(len(T), dtype=bool)
    pairs = near[same]
    # Best first: a grasp that is dropped itself drops no other
    for better, worse in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        if not duplicates[better]:
            duplicates[worse] = True
    return duplicates

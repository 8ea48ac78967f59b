"""Several grasp generators as one: all their grasps scored by one discriminator, the best kept."""

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
_SAME_WAY_RAD = np.deg2rad(8.0)


class Scorer(Protocol):
    """Judges grasps, whoever proposed them."""

    def score(self, points: np.ndarray, grasps: GraspSet, seed: int) -> np.ndarray:
        """Return scores (N,) in [0, 1] of `grasps` on the object's `points` (M, 3) [m]."""
        ...


class UnionSampler:
    """A `GraspGenerator` that asks several and keeps the best.

    Each member is asked for all `n` grasps, so that the union is not the worse for any of them: it costs what they
    cost together, and the scoring. Of grasps that are nearly the same (3 mm, 8°, the jaws' two sides alike) only the
    best counts. How many come from whom is left to the scores alone. A member that finds no grasps on a cloud is
    passed over as long as another finds some.
    """

    def __init__(self, members: Sequence[GraspGenerator], scorer: Scorer | None = None) -> None:
        """Take the members; the scorer is the discriminator of the weights that ship if None.

        Raises:
            ValueError: fewer than two members.
            WeightsError: the discriminator's weights are missing or damaged.
        """
        if len(members) < 2:
            raise InvalidValueError(f"A union of {len(members)} generator makes no sense; give two or more.")
        if scorer is None:
            from models.diffusion.scorer import GraspScorer

            scorer = GraspScorer()
        self.members = tuple(members)
        self._scorer = scorer

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return the best `n` of the members' grasps for `points` (M, 3) [m], best score first.

        Where thinning leaves fewer than `n`, the best of the near copies fill up.

        Raises:
            ValueError: as `check_object_cloud`; or no member finds any grasp, with the first one's reason.
        """
        points = check_object_cloud(points, n)
        found = self._ask(points, n, seed)
        T = np.concatenate([grasps.T_camera_grasps for grasps in found])
        widths = np.concatenate([grasps.widths_m for grasps in found])
        source = "union:" + "+".join(grasps.source for grasps in found)
        proposed = GraspSet(T_camera_grasps=T, scores=np.zeros(len(T)), widths_m=widths, source=source)
        scores = self._scorer.score(points, proposed, seed)
        order = np.argsort(-scores, kind="stable")
        copies = find_copies(T[order])
        chosen = np.concatenate([order[~copies], order[copies]])[:n]
        chosen = chosen[np.argsort(-scores[chosen], kind="stable")]
        return GraspSet(T_camera_grasps=T[chosen], scores=scores[chosen], widths_m=widths[chosen], source=source)

    def _ask(self, points: np.ndarray, n: int, seed: int) -> list[GraspSet]:
        found, refusals = [], []
        for member in self.members:
            try:
                found.append(member.sample(points, n, seed))
            except ValueError as err:
                refusals.append(err)
        if not found:
            raise refusals[0]
        for refusal in refusals:
            _LOG.info("a member of the union found no grasps: %s", refusal)
        return found


def find_copies(T: np.ndarray) -> np.ndarray:
    """Return which (N,) of the poses `T` (N, 4, 4), best first, are nearly the same as a better one that is kept."""
    near = KDTree(T[:, :3, 3]).query_pairs(_SAME_PLACE_M, output_type="ndarray")
    near = np.sort(near, axis=1)
    first, second = near[:, 0], near[:, 1]
    approach = np.sum(T[first, :3, 2] * T[second, :3, 2], axis=1)
    closing = np.abs(np.sum(T[first, :3, 1] * T[second, :3, 1], axis=1))
    same = (approach > np.cos(_SAME_WAY_RAD)) & (closing > np.cos(_SAME_WAY_RAD))
    copies = np.zeros(len(T), dtype=bool)
    pairs = near[same]
    for better, worse in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        if not copies[better]:
            copies[worse] = True
    return copies

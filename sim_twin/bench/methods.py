"""The orders in which a method tries the very same candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from models.mvbb import FitMethod, RankedGrasps, fit_obb, rank_by_score, rank_grasps
from models.types import GraspSet
from sim_twin.bench.seen import Seen
from z1_runtime.decision import Decider, StageTimes


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """How candidates are filtered and ranked."""

    name: str
    """As the reports call it."""
    rank_by: Literal["score", "box", "full"]
    """The generator's score; the paper's MVBB; or all that the runtime knows."""
    collision_filter: bool = True
    """Whether grasps that hit the point cloud are dropped before the ranking."""
    box: FitMethod = "pca"
    """How the box is fitted."""
    k: int = 2
    """Faces that may be approached."""
    alpha: float = 0.85
    """Weight of the alignment."""
    hard_filter: bool = True
    """Whether grasps with a_j ≤ 0 are dropped; without it they only rank low."""

    def order(self, seen: Seen, decider: Decider, times: StageTimes) -> tuple[RankedGrasps, np.ndarray]:
        """Return the candidates in the order to try them, and which (M,) were left before the ranking.

        The ranking's own indices count in those that were left.

        Args:
            seen: the look, with its candidates.
            decider: whose kinematics, gripper and box settings are used.
            times: gets the stages `filter` (of collisions) and `rank` (fit, filter by the box, score).

        Raises:
            DegenerateCloudError: the object's cloud spans no box.
            NoPlanError: `full` keeps none.
        """
        left = np.arange(len(seen.candidates))
        if self.rank_by != "full" and self.collision_filter:
            left = np.flatnonzero(seen.free(decider, times))
        with times.stage("rank"):
            return self._rank(seen.candidates[left], seen, decider), left

    def _rank(self, candidates: GraspSet, seen: Seen, decider: Decider) -> RankedGrasps:
        observation = seen.observation
        if self.rank_by == "full":
            return decider.rank(candidates, observation)
        if self.rank_by == "score":
            return rank_by_score(candidates)
        box = fit_obb(observation.object_points, self.box, up=observation.T_base_camera[2, :3])
        return rank_grasps(candidates, box, k=self.k, alpha=self.alpha, hard_filter=self.hard_filter)


METHODS = {
    "vanilla": Method(name="vanilla", rank_by="score"),
    "mvb": Method(name="mvb", rank_by="box"),
    "full": Method(name="full", rank_by="full"),
}
"""`vanilla` and `mvb` are the paper's; `full` is the runtime's own."""
_SETTINGS = {"k": int, "alpha": float, "box": str, "hard_filter": "bool", "collision_filter": "bool"}


def file_name(method: str) -> str:
    """Return the name of a method without what a file's name cannot hold."""
    return "".join(letter if letter.isalnum() or letter in ".-_" else "_" for letter in method)


def parse_method(text: str) -> Method:
    """Return the method that `text` names: `mvb`, or with settings `mvb:k=3,alpha=0.5,box=upright,hard_filter=no`.

    Raises:
        ValueError: no such method or setting.
    """
    name, _, settings = text.partition(":")
    if name not in METHODS:
        raise ValueError(f"there is no method {name!r}; known: {', '.join(METHODS)}.")
    changes: dict[str, object] = {}
    for setting in filter(None, settings.split(",")):
        key, _, value = setting.partition("=")
        if key not in _SETTINGS:
            raise ValueError(f"method {text!r} has an unknown setting {key!r}; known: {', '.join(_SETTINGS)}.")
        changes[key] = _converted(text, key, value)
    return replace(METHODS[name], name=text, **changes)  # pyright: ignore[reportArgumentType]


def _converted(text: str, key: str, value: str) -> object:
    kind = _SETTINGS[key]
    if kind == "bool":
        if value not in ("yes", "no"):
            raise ValueError(f"method {text!r}: {key} is {value!r}; say yes or no.")
        return value == "yes"
    try:
        converted = kind(value)  # pyright: ignore[reportCallIssue]
    except ValueError as error:
        raise ValueError(f"method {text!r}: {key} is {value!r}, which is no number.") from error
    if key == "box" and value not in ("pca", "min_volume", "upright"):
        raise ValueError(f"method {text!r}: box is {value!r}; allowed: pca, min_volume, upright.")
    return converted

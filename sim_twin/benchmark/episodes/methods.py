"""Methods: orders in which the same candidates are tried."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from hal.base.errors import InvalidValueError
from models.obb.mvbb import FitMethod, RankedGrasps, fit_obb, rank_by_score, rank_grasps
from sim_twin.benchmark.episodes.shared_observation import SharedObservation
from z1_runtime.grasping.grasp_candidates import EARLY_EXIT_CHUNK
from z1_runtime.grasping.ranking import Ranking, ScoringHead, fit_upright_box, load_scoring, measure_features
from z1_runtime.planning.reachability import RankedCandidates
from z1_runtime.tasks.grasp_selection import GraspSelector, StageTimes


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """Filter and ranking of the candidates; None keeps the configuration's value."""

    name: str
    """Name in reports and rows."""
    rank_by: Literal["score", "box", "full"]
    """The generator's score; the paper's MVBB; or the runtime's own ranking."""
    collision_filter: bool = True
    """Whether grasps that hit the point cloud are dropped before the ranking; `full` has its own check."""
    box: FitMethod | None = None
    """Fit of the box."""
    k: int | None = None
    """Number of faces that may be approached."""
    alpha: float | None = None
    """Weight of the alignment."""
    hard_filter: bool | None = None
    """Whether grasps with a_j ≤ 0 are dropped; without it they only rank low."""
    min_alignment: float | None = None
    """Alignment below which grasps come last."""
    min_score: float | None = None
    """Generator score below which grasps come last."""
    head: ScoringHead | None = None
    """Scoring head that orders the grasps instead of α, or of the runtime's weights."""

    def ranking(self, configured: Ranking) -> Ranking:
        """Return the numbers of its ranking; those that it does not set are `configured`."""
        own = {
            "box_method": self.box,
            "k_faces": self.k,
            "alpha": self.alpha,
            "hard_filter": self.hard_filter,
            "min_alignment": self.min_alignment,
            "min_score": self.min_score,
            "head": self.head,
        }
        return replace(configured, **{name: value for name, value in own.items() if value is not None})

    def order(
        self, shared: SharedObservation, selector: GraspSelector, times: StageTimes
    ) -> tuple[RankedCandidates, np.ndarray]:
        """Return the candidates in the order to try them, and which (M,) were left before the ranking.

        The ranking's own indices count in these.

        Args:
            shared: the observation, with its candidates.
            selector: whose kinematics, gripper and box settings are used.
            times: gets the stages `collision` (the scene), `filter` (of collisions) and `rank` (fit, filter by the
                box, score).

        Raises:
            DegenerateCloudError: the object's cloud spans no box.
            NoPlanError: `full` keeps none.
        """
        scene = shared.scene(selector, times)
        if self.rank_by == "full":
            ranking = self.ranking(selector.ranking)
            with times.stage("rank"):
                filtered = selector.filter(shared.candidates, shared.observation, ranking)
                return selector.rank(filtered, scene, ranking), np.arange(len(shared.candidates))
        fitted = shared.fitted(selector, times) if self.collision_filter else None
        left = np.arange(len(shared.candidates)) if fitted is None else np.flatnonzero(fitted.free())
        with times.stage("rank"):
            ranked, ranking = self._rank_left(shared, left)
            if fitted is not None:
                candidates = fitted.reordered(left[ranked.indices])
            else:
                candidates = selector.fit_candidates(ranked.grasps, scene, chunk=EARLY_EXIT_CHUNK)
            if ranking is None:
                return RankedCandidates(ranked=ranked, candidates=candidates), left
            return _order_by(ranking, RankedCandidates(ranked=ranked, candidates=candidates)), left

    def _rank_left(self, shared: SharedObservation, left: np.ndarray) -> tuple[RankedGrasps, Ranking | None]:
        """Return the candidates `left` (M,) by score, or by the paper's box and then with the ranking of that box."""
        grasps = shared.candidates[left]
        if self.rank_by == "score":
            return rank_by_score(grasps), None
        ranking, observation = self.ranking(Ranking()), shared.observation
        box = fit_obb(observation.object_points, ranking.box_method, up=observation.T_base_camera[2, :3])
        return rank_grasps(
            grasps, box, k=ranking.k_faces, alpha=ranking.alpha, hard_filter=ranking.hard_filter
        ), ranking


def _order_by(ranking: Ranking, by_box: RankedCandidates) -> RankedCandidates:
    """Return the paper's order, or with a head the head's; candidates below a threshold come last."""
    ranked, candidates = by_box.ranked, by_box.candidates
    if ranking.box_method == "upright":
        candidates = replace(candidates, upright_box=ranked.box)
    elif ranking.head is not None and len(ranked):
        candidates = replace(candidates, upright_box=fit_upright_box(candidates.scene.observation))
    scores = ranked.scores
    if ranking.head is not None and len(ranked):
        scores = ranking.head.probability(measure_features(candidates))
    passes = ranking.passes_thresholds(ranked.alignments, ranked.grasps.scores)
    scores = np.where(passes, scores, scores - _BEHIND)
    order = np.argsort(-scores, kind="stable")  # as `RankedGrasps.reordered` sorts
    return RankedCandidates(ranked=ranked.reordered(scores), candidates=candidates.reordered(order))


_BEHIND = 2.0
"""Greater than any difference of two scores."""
METHODS = {
    "vanilla": Method(name="vanilla", rank_by="score"),
    "mvb": Method(name="mvb", rank_by="box", box="pca", k=2, alpha=0.85, hard_filter=True),
    "full": Method(name="full", rank_by="full"),
}
"""`vanilla` and `mvb` are the paper's; `full` is the runtime's own."""
_NUMBERS = {"k": int, "alpha": float, "min_alignment": float, "min_score": float}
_OF_BOX = (*_NUMBERS, "box", "hard_filter", "scoring")
_SETTINGS = {"vanilla": ("collision_filter",), "mvb": (*_OF_BOX, "collision_filter"), "full": _OF_BOX}
"""Settings that can be changed, by method."""


def file_name(method: str) -> str:
    """Return the name of a method without what a file's name cannot hold."""
    return "".join(letter if letter.isalnum() or letter in ".-_" else "_" for letter in method)


def parse_method(text: str) -> Method:
    """Return the method that `text` names: `mvb`, or with settings `mvb:k=3,alpha=0.5,box=upright,hard_filter=no`.

    `scoring=FILE` takes all numbers from a file of `./z1 tune`; further settings go over them.

    Raises:
        ValueError: no such method or setting.
        ScoringError: the file cannot be used.
    """
    name, _, settings = text.partition(":")
    if name not in METHODS:
        raise InvalidValueError(
            f"method: the name is unknown ({name!r}, allowed {', '.join(METHODS)}). Choose one of these.",
            code="unknown_method",
        )
    changes: dict[str, object] = {}
    for setting in filter(None, settings.split(",")):
        key, _, value = setting.partition("=")
        if key not in _SETTINGS[name]:
            raise InvalidValueError(
                f"method {text!r}: a setting is unknown ({key!r}, allowed {', '.join(_SETTINGS[name])}). Use these.",
                code="unknown_setting",
            )
        if key == "scoring":
            changes = {**_load_settings(name, Path(value)), **changes}
        else:
            changes[key] = _parse_value(text, key, value)
    method = replace(METHODS[name], name=text, **changes)  # pyright: ignore[reportArgumentType]
    try:
        method.ranking(Ranking())
    except ValueError as error:
        raise InvalidValueError(f"method {text!r}: {error}", code="method_value") from error
    return method


def _load_settings(name: str, path: Path) -> dict[str, object]:
    ranking = getattr(load_scoring(path), name)
    values = {each.name: getattr(ranking, each.name) for each in fields(Ranking)}
    return {"box": values.pop("box_method"), "k": values.pop("k_faces"), **values}


def _parse_value(text: str, key: str, value: str) -> object:
    if key in ("hard_filter", "collision_filter"):
        if value not in ("yes", "no"):
            raise InvalidValueError(
                f"method {text!r}: {key} is invalid ({value!r}, allowed yes or no). Give one of these.",
                code="method_value",
            )
        return value == "yes"
    if key == "box":
        if value not in get_args(FitMethod):
            raise InvalidValueError(
                f"method {text!r}: box is unknown ({value!r}, allowed {', '.join(get_args(FitMethod))}). "
                "Give one of these.",
                code="method_value",
            )
        return value
    try:
        return _NUMBERS[key](value)
    except ValueError as error:
        raise InvalidValueError(
            f"method {text!r}: {key} is invalid ({value!r}, allowed numbers). Give a number.", code="method_value"
        ) from error

"""One episode as a row of a table: scenario, observation, plan and outcome."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np

from models.obb.mvbb import RankedGrasps
from sim_twin.benchmark.episodes.execution import Mode, Outcome
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.episodes.shared_observation import SharedObservation
from sim_twin.benchmark.episodes.targeting import compute_iou
from z1_runtime.grasping.ranking import FEATURES
from z1_runtime.tasks.grasp_selection import StageTimes
from z1_runtime.types import GraspPlan, Rejection, RejectionReason

Row = dict[str, Any]
"""One episode: column to value, see `make_row`. A column that does not apply is missing, in the table None."""

TRACEBACK = "traceback"
"""Key of an error row's traceback."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Attempt:
    """One observation and its results, as far as the attempt came."""

    times: StageTimes
    outcome: Outcome | None = None
    """None before its plan is executed."""
    shared: SharedObservation | None = None
    ranked: RankedGrasps | None = None
    left: np.ndarray | None = None
    """(M,) candidates before the ranking, whose indices count in these."""
    plan: GraspPlan | None = None
    rejections: Sequence[Rejection] = ()
    features: np.ndarray | None = None
    """(2, 11) of `z1_runtime.grasping.ranking.FEATURES`, of the first-ranked and, if there is a plan, of the executed
    grasp."""

    @property
    def ended(self) -> Outcome:
        """The outcome, once there is one."""
        assert self.outcome is not None, "this attempt was not executed"
        return self.outcome


def make_row(
    scenario: Scenario,
    method: str,
    attempts: Sequence[Attempt],
    *,
    top_k: int = 1,
    given_up: str = "",
    qpos: np.ndarray | None = None,
) -> Row:
    """Return the row of one method's episode.

    Observation, decision and outcome are those of the last attempt; `success_top1` is of the first.

    Args:
        scenario: `object`, `distance`, …, and the physics and neighbours that were sample for it.
        method: its name.
        attempts: one or more; `attempts`, `modes` and `ranks` describe each, `success_after` (top_k,) whether the
            object was lifted within one, two, … of them.
        top_k: how many there might have been.
        given_up: why there were no more, if that was not for success or their number.
        qpos: MuJoCo's positions at the end; None where nothing moved.
    """
    first, last = attempts[0], attempts[-1]
    success = last.ended.mode is Mode.SUCCESS
    row: Row = {**scenario.columns(), "method": method, "version": _version()}
    row |= {"success": success, "success_top1": _is_top1(first)}
    row |= {
        "top_k": top_k,
        "attempts": len(attempts),
        "modes": [attempt.ended.mode.value for attempt in attempts],
        "ranks": [-1 if attempt.plan is None else attempt.plan.rank for attempt in attempts],
        "success_after": [success and len(attempts) <= k for k in range(1, top_k + 1)],
        "given_up": given_up,
    }
    row |= asdict(last.ended) | {"mode": last.ended.mode.value}
    row |= {f"{stage}_ms": ms for stage, ms in last.times.ms.items()}
    reasons = Counter(rejection.reason for rejection in last.rejections)
    row |= {f"rejected_{reason}": reasons[reason] for reason in RejectionReason}
    row |= _observation_columns(last.shared) | _ranking_columns(last) | _plan_columns(last) | _feature_columns(last)
    return row if qpos is None else row | {"final_qpos": qpos.tolist()}


def make_error_row(scenario: Scenario, method: str, error: Exception, *, top_k: int = 1) -> Row:
    """Return the row of an episode that `error` ended: a failure of this episode alone.

    `error_type` and `detail` hold the exception's type and text; `TRACEBACK` is for the run's log (see
    `sim_twin.benchmark.results.store.Store.add`) and no column of the table.
    """
    mode = Mode.ERROR.value
    # Not `columns()`: sampling the neighbours may be what failed
    row: Row = {**scenario.identity(), "method": method, "version": _version()}
    row |= {"success": False, "success_top1": False, "top_k": top_k, "attempts": 1, "modes": [mode], "ranks": [-1]}
    row |= {"success_after": [False] * top_k, "given_up": "", "mode": mode}
    row |= {"detail": str(error), "error_type": type(error).__name__}
    return row | {TRACEBACK: "".join(traceback.format_exception(error))}


def _is_top1(attempt: Attempt) -> bool:
    return attempt.ended.mode is Mode.SUCCESS and attempt.plan is not None and attempt.plan.rank == 0


@cache
def _version() -> str:
    return version("z1-grasp")


def _observation_columns(shared: SharedObservation | None) -> Row:
    if shared is None:
        return {}
    detection, ground_truth = shared.observation.detection, shared.frame.ground_truth_mask
    return {
        "n_object_points": len(shared.observation.object_points),
        "n_candidates": len(shared.candidates),
        "detection_label": detection.label,
        "detection_confidence": detection.confidence,
        "iou": float("nan") if ground_truth is None else compute_iou(detection, ground_truth),
    }


def _ranking_columns(attempt: Attempt) -> Row:
    ranked, shared, left = attempt.ranked, attempt.shared, attempt.left
    if ranked is None or shared is None or left is None:
        return {}
    row: Row = {"n_free": len(left), "n_ranked": len(ranked)}
    if ranked.box is not None:
        normals = ranked.box.face_normals[ranked.faces] @ shared.observation.T_base_camera[:3, :3].T
        row |= {"box_extents_m": ranked.box.extents_m.tolist(), "faces": ranked.faces.tolist()}
        row |= {"face_normals": normals.ravel().tolist()}
    return row


def _plan_columns(attempt: Attempt) -> Row:
    plan, ranked, left = attempt.plan, attempt.ranked, attempt.left
    if plan is None or ranked is None or left is None:
        return {}
    return {
        "rank": plan.rank,
        "alignment": float(ranked.alignments[plan.rank]),
        "rank_score": float(ranked.scores[plan.rank]),
        "generator_score": float(ranked.grasps.scores[plan.rank]),
        "candidate": int(left[ranked.indices[plan.rank]]),
        "width_m": plan.width_m,
        "jaw_open": plan.jaw_open,
        "ik_method": plan.ik_method,
        "T_base_grasp": plan.T_base_grasp.ravel().tolist(),
        "T_base_pivot": plan.T_base_pivot.ravel().tolist(),
    }


def _feature_columns(attempt: Attempt) -> Row:
    """Return the features for a scoring head: `first_…` of the first-ranked grasp, `grasp_…` of the executed one."""
    ranked, left, features = attempt.ranked, attempt.left, attempt.features
    if ranked is None or left is None or features is None:
        return {}
    row: Row = {
        "first_candidate": int(left[ranked.indices[0]]),
        "first_box_alignment": float(ranked.alignments[0]),
    }
    row |= {f"first_{name}": float(value) for name, value in zip(FEATURES, features[0], strict=True)}
    if attempt.plan is not None:
        row |= {f"grasp_{name}": float(value) for name, value in zip(FEATURES, features[1], strict=True)}
    return row

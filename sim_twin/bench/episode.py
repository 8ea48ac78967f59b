"""One scenario, seen once, decided and executed by each method in turn: a row a method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hal.messages import RgbdFrame
from models.mvbb import RankedGrasps
from models.obb import DegenerateCloudError
from models.types import GraspSet
from sim_twin.bench.methods import Method, file_name
from sim_twin.bench.occlusion import occlude
from sim_twin.bench.recordings import Recordings
from sim_twin.bench.scenarios import Scenario
from sim_twin.bench.trial import Mode, Outcome, act, look
from z1_runtime.cloud import PerceptionError
from z1_runtime.decision import Decider, StageTimes
from z1_runtime.planner import NoPlanError
from z1_runtime.trajectory import MotionLimits
from z1_runtime.types import GraspPlan, Observation, Rejection

Row = dict[str, Any]
"""One episode: column name to value, see `COLUMNS` in `sim_twin.bench.rows`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What all methods share of one scenario."""

    frame: RgbdFrame
    q: np.ndarray
    """(7,) joints it was taken at [rad]."""
    observation: Observation
    candidates: GraspSet
    times: StageTimes
    """detect, cloud, generate."""


def run_scenario(
    scenario: Scenario,
    methods: Sequence[Method],
    make_decider: Callable[[int], Decider],
    recordings: Recordings | None = None,
) -> list[Row]:
    """Return one row for each of `methods`, all on the same frame and the same candidates.

    Args:
        scenario: what stands where.
        methods: how candidates are ordered.
        make_decider: returns the runtime's decider with the generator's seed set to its argument.
        recordings: which episodes are written for Rerun too.
    """
    scene, decider = scenario.scene(), make_decider(scenario.draw_seed)
    frame, q = look(scene)
    frame = occlude(frame, scenario.occlusion, scenario.draw_seed)
    times = StageTimes()
    try:
        observation = decider.observe(frame, q, times)
    except PerceptionError as error:
        return [_row(scenario, method, Outcome(mode=Mode.NO_DETECTION, detail=str(error)), times) for method in methods]
    try:
        with times.stage("generate"):
            candidates = decider.propose(observation)
    except ValueError as error:
        return [_row(scenario, method, Outcome(mode=Mode.NO_CANDIDATE, detail=str(error)), times) for method in methods]
    seen = Seen(frame=frame, q=q, observation=observation, candidates=candidates, times=times)
    return [_run_method(scenario, method, decider, seen, recordings) for method in methods]


def _run_method(scenario: Scenario, method: Method, decider: Decider, seen: Seen, recordings: Recordings | None) -> Row:
    times = StageTimes()
    times.ms.update(seen.times.ms)
    ranked, n_free, plan, final = None, -1, None, {}
    try:
        with times.stage("rank"):
            ranked, n_free = method.order(seen.candidates, seen.observation, decider, seen.q)
        plan = decider.planner.plan(ranked.grasps, seen.observation, seen.q, times.stage)
    except (DegenerateCloudError, NoPlanError) as error:
        rejections = error.rejections if isinstance(error, NoPlanError) else ()
        outcome = Outcome(mode=_why_no_plan(rejections), detail=str(error))
    else:
        rejections = plan.rejections
        limits = MotionLimits.at_speed(decider.config.speed)
        outcome, qpos = act(scenario.scene(), plan, decider.kinematics, limits)
        final["final_qpos"] = qpos.tolist()
    row = _row(scenario, method, outcome, times, seen, ranked=ranked, n_free=n_free, plan=plan, rejections=rejections)
    if recordings is not None:
        name, success = f"{scenario.key}-{file_name(method.name)}", row["success"]
        recordings.keep(name, success=success, observation=seen.observation, ranked=ranked, plan=plan)
    return row | final


def _why_no_plan(rejections: Sequence[Rejection]) -> Mode:
    """Return the stage at which the candidate that came furthest was refused."""
    reasons = {rejection.reason for rejection in rejections}
    if "path" in reasons or "self" in reasons:
        return Mode.NO_PATH
    return Mode.NO_IK if "ik" in reasons else Mode.NO_CANDIDATE


def _row(
    scenario: Scenario,
    method: Method,
    outcome: Outcome,
    times: StageTimes,
    seen: Seen | None = None,
    *,
    ranked: RankedGrasps | None = None,
    n_free: int = -1,
    plan: GraspPlan | None = None,
    rejections: Sequence[Rejection] = (),
) -> Row:
    success = outcome.mode is Mode.SUCCESS
    row: Row = {**scenario.features(), "method": method.name}
    row |= {"success": success, "success_top1": success and plan is not None and plan.rank == 0}
    row |= asdict(outcome) | {"mode": outcome.mode.value}
    row |= {f"{stage}_ms": ms for stage, ms in times.ms.items()}
    reasons = Counter(rejection.reason for rejection in rejections)
    row |= {
        f"rejected_{reason}": reasons[reason] for reason in ("width", "table", "scene", "object", "self", "ik", "path")
    }
    if seen is not None:
        row |= {"n_object_points": len(seen.observation.object_points), "n_candidates": len(seen.candidates)}
        row |= {"detection_confidence": seen.observation.detection.confidence, "iou": _iou(seen)}
    if ranked is not None:
        row |= {"n_free": n_free, "n_ranked": len(ranked)}
        if ranked.box is not None:
            T_base_camera = seen.observation.T_base_camera if seen else np.eye(4)
            normals = ranked.box.face_normals[ranked.faces] @ T_base_camera[:3, :3].T
            row |= {"box_extents_m": ranked.box.extents_m.tolist(), "faces": ranked.faces.tolist()}
            row |= {"face_normals": normals.ravel().tolist()}
    if plan is not None and ranked is not None:
        index = int(ranked.indices[plan.rank])
        row |= {
            "rank": plan.rank,
            "alignment": float(ranked.alignments[plan.rank]),
            "rank_score": float(ranked.scores[plan.rank]),
            "generator_score": float(seen.candidates.scores[index]) if seen else np.nan,
            "candidate": index,
            "width_m": plan.width_m,
            "jaw_open": plan.jaw_open,
            "ik_method": plan.ik_method,
            "T_base_grasp": plan.T_base_grasp.ravel().tolist(),
            "T_base_pivot": plan.T_base_pivot.ravel().tolist(),
        }
    return row


def _iou(seen: Seen) -> float:
    """Return how well the detector's mask meets the truth."""
    mask, truth = seen.observation.detection.mask, seen.frame.truth_mask
    if mask is None or truth is None:
        return float("nan")
    return float((mask & truth).sum() / max((mask | truth).sum(), 1))

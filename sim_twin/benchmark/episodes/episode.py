"""One scenario, observed once, planned and executed by each method in turn: one row per method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hal.base.errors import HalError
from hal.base.messages import RgbdFrame
from models.obb.obb import DegenerateCloudError
from sim_twin.benchmark.episodes.execution import RETRIED, EpisodeRobot, Mode, Outcome, capture
from sim_twin.benchmark.episodes.methods import Method, file_name
from sim_twin.benchmark.episodes.occlusion import occlude
from sim_twin.benchmark.episodes.recordings import Recordings, record
from sim_twin.benchmark.episodes.rows import Attempt, Row, make_error_row, make_row
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.episodes.shared_observation import SharedObservation
from z1_runtime.grasping.ranking import measure_features
from z1_runtime.motion.executor import MotionError
from z1_runtime.perception.detector import PerceptionError
from z1_runtime.planning.planner import NoPlanError
from z1_runtime.planning.reachability import RankedCandidates
from z1_runtime.tasks.grasp_selection import GraspSelector, StageTimes
from z1_runtime.types import Rejection, RejectionReason

MakeDecider = Callable[[Scenario, int], GraspSelector]
"""Return the runtime's grasp selector for a scenario, with the generator's seed set to the second argument."""


def run_scenario(
    scenario: Scenario,
    methods: Sequence[Method],
    make_grasp_selector: MakeDecider,
    *,
    top_k: int = 1,
    recordings: Recordings | None = None,
) -> list[Row]:
    """Return one row for each of `methods`, all on the same first frame and the same candidates.

    Args:
        scenario: what is_stable where.
        methods: orders of the candidates.
        make_grasp_selector: called once for each attempt.
        top_k: candidates that may be executed; after a failure the scene as it then is is captured again.
        recordings: the episodes to record for Rerun too.
    """
    selector = make_grasp_selector(scenario, scenario.draw_seed)  # settings that cannot be used end the run here
    try:
        shared = _observe_first(scenario, selector)
    except Exception as error:  # one scenario's defect must not cost the run the others
        return [make_error_row(scenario, method.name, error, top_k=top_k) for method in methods]
    rows = []
    for method in methods:
        try:
            row = (
                make_row(scenario, method.name, [shared], top_k=top_k)
                if isinstance(shared, Attempt)
                else _run_method(scenario, method, make_grasp_selector, shared, top_k=top_k, recordings=recordings)
            )
        except Exception as error:  # as above: the row keeps type, text and traceback
            row = make_error_row(scenario, method.name, error, top_k=top_k)
        rows.append(row)
    return rows


def record_scenario(scenario: Scenario, method: Method, make_grasp_selector: MakeDecider, folder: Path) -> Path | None:
    """Write observation, ranking and plan of the first attempt of `method` as <scenario>-<method>.rrd in `folder`.

    Returns:
        The file, or None where nothing is detected.
    """
    selector = make_grasp_selector(scenario, scenario.draw_seed)
    shared = _observe_first(scenario, selector)
    if isinstance(shared, Attempt):
        return None
    return record(folder / recording_name(scenario, method), _decide(method, selector, shared))


def recording_name(scenario: Scenario, method: Method) -> str:
    """Return the name of an episode's recording."""
    return f"{scenario.key}-{file_name(method.name)}.rrd"


def _observe_first(scenario: Scenario, selector: GraspSelector) -> SharedObservation | Attempt:
    """Return the observation from home, or the attempt that ended with it."""
    frame, q = capture(scenario.scene())
    return _observe(scenario, selector, frame, q)


def _observe(
    scenario: Scenario, selector: GraspSelector, frame: RgbdFrame, q: np.ndarray
) -> SharedObservation | Attempt:
    times = StageTimes()
    try:
        return SharedObservation.by(selector, occlude(frame, scenario.occlusion, scenario.draw_seed), q, times)
    except PerceptionError as error:
        return Attempt(outcome=Outcome(mode=Mode.NO_DETECTION, detail=str(error)), times=times)
    except ValueError as error:
        if "generate" not in times.ms:
            raise
        return Attempt(outcome=Outcome(mode=Mode.NO_CANDIDATE, detail=str(error)), times=times)


def _run_method(
    scenario: Scenario,
    method: Method,
    make_grasp_selector: MakeDecider,
    shared: SharedObservation,
    *,
    top_k: int,
    recordings: Recordings | None,
) -> Row:
    selector = make_grasp_selector(scenario, scenario.draw_seed)
    first = _decide(method, selector, shared)
    attempts, given_up, qpos = [first], "", None
    if first.plan is not None:
        with EpisodeRobot(scenario.scene(), selector.kinematics, selector.config.speed) as robot:
            attempts, given_up = _execute_attempts(scenario, method, make_grasp_selector, robot, first, top_k=top_k)
            qpos = robot.world.data.qpos.copy()
    row = make_row(scenario, method.name, attempts, top_k=top_k, given_up=given_up, qpos=qpos)
    if recordings is not None and recordings.wants(success=row["success"]):
        record(recordings.folder / recording_name(scenario, method), first)
    return row


def _execute_attempts(
    scenario: Scenario,
    method: Method,
    make_grasp_selector: MakeDecider,
    robot: EpisodeRobot,
    first: Attempt,
    *,
    top_k: int,
) -> tuple[list[Attempt], str]:
    """Execute `first` and, after a failure, new plans; return all attempts and why there are no more."""
    attempt = first
    attempts: list[Attempt] = []
    while True:
        assert attempt.plan is not None
        outcome = robot.execute(attempt.plan)
        attempts.append(replace(attempt, outcome=outcome))
        if outcome.mode not in RETRIED or len(attempts) == top_k:
            return attempts, ""
        # Another seed: a retry is to have other candidates
        selector = make_grasp_selector(scenario, scenario.draw_seed + len(attempts))
        try:
            robot.withdraw(attempt.plan, outcome, selector.config.jaw_home)
            if len(attempts) == 1:
                robot.capture()  # this robot's first frame would have the noise of the episode's first frame
            found = _observe(scenario, selector, *robot.capture())
        except (MotionError, HalError) as error:
            return attempts, f"{Mode.STOPPED.value}: {error}"
        attempt = found if isinstance(found, Attempt) else _decide(method, selector, found)
        if attempt.plan is None:
            return attempts, f"{attempt.ended.mode.value}: {attempt.ended.detail}"


def _decide(method: Method, selector: GraspSelector, shared: SharedObservation) -> Attempt:
    """Return the attempt of `method`; without a plan where there is none."""
    times = StageTimes()
    times.ms |= shared.times.ms
    best_first = left = None
    try:
        best_first, left = method.order(shared, selector, times)
        plan = selector.planner.plan(best_first.candidates, shared.q, times.stage)
    except (DegenerateCloudError, NoPlanError) as error:
        rejections = error.rejections if isinstance(error, NoPlanError) else ()
        outcome = Outcome(mode=_why_no_plan(rejections), detail=str(error))
        ranked = best_first and best_first.ranked
        attempt = Attempt(times=times, outcome=outcome, shared=shared, ranked=ranked, left=left, rejections=rejections)
    else:
        ranked = best_first.ranked
        attempt = Attempt(times=times, shared=shared, ranked=ranked, left=left, plan=plan, rejections=plan.rejections)
    return replace(attempt, features=_features(attempt, best_first))


def _features(attempt: Attempt, best_first: RankedCandidates | None) -> np.ndarray | None:
    """Return what a scoring head would go by (see `Attempt.features`), where something was ranked."""
    if best_first is None or not len(best_first.candidates):
        return None
    of = [0, 0 if attempt.plan is None else attempt.plan.rank]
    try:
        return measure_features(best_first.candidates.reordered(np.array(of)))
    except DegenerateCloudError:  # a method that fits no box goes on without one
        return None


def _why_no_plan(rejections: Sequence[Rejection]) -> Mode:
    """Return the stage of the rejection of the candidate that came furthest."""
    reasons = {rejection.reason for rejection in rejections}
    if reasons & {RejectionReason.PATH, RejectionReason.SELF}:
        return Mode.NO_PATH
    return Mode.NO_IK if RejectionReason.IK in reasons else Mode.NO_CANDIDATE

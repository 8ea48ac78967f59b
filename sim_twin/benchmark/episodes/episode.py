"""One scenario, seen once, decided and executed by each method in turn: a row a method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hal.base.errors import HalError
from hal.base.messages import RgbdFrame
from models.obb.obb import DegenerateCloudError
from sim_twin.benchmark.episodes.methods import Method, file_name
from sim_twin.benchmark.episodes.occlusion import occlude
from sim_twin.benchmark.episodes.recordings import Recordings, record
from sim_twin.benchmark.episodes.rows import Attempt, Row, make_row
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.episodes.seen import SharedObservation
from sim_twin.benchmark.episodes.trial import RETRIED, Mode, Outcome, Robot, look
from z1_runtime.grasping.features import measure_features
from z1_runtime.motion.executor import MotionError
from z1_runtime.perception.errors import PerceptionError
from z1_runtime.planning.planner import NoPlanError
from z1_runtime.planning.reachability import RankedCandidates
from z1_runtime.tasks.grasp_selection import GraspSelector, StageTimes
from z1_runtime.types import Rejection, RejectionReason

MakeDecider = Callable[[Scenario, int], GraspSelector]
"""Returns the runtime's decider for a scenario, with the generator's seed set to the second argument."""


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
        scenario: what stands where.
        methods: how candidates are ordered.
        make_grasp_selector: called once for each attempt.
        top_k: candidates that may be executed; after a failure the scene is looked at again, as it then is.
        recordings: which episodes are written for Rerun too.
    """
    decider = make_grasp_selector(scenario, scenario.draw_seed)
    seen = _first_look(scenario, decider)
    if isinstance(seen, Attempt):
        return [make_row(scenario, method.name, [seen], top_k=top_k) for method in methods]
    return [
        _run_method(scenario, method, make_grasp_selector, seen, top_k=top_k, recordings=recordings)
        for method in methods
    ]


def record_scenario(scenario: Scenario, method: Method, make_grasp_selector: MakeDecider, folder: Path) -> Path | None:
    """Write what `method` sees, ranks and chooses at its first look as <scenario>-<method>.rrd in `folder`.

    Returns:
        The file, or None where nothing is seen.
    """
    decider = make_grasp_selector(scenario, scenario.draw_seed)
    seen = _first_look(scenario, decider)
    if isinstance(seen, Attempt):
        return None
    return record(folder / recording_name(scenario, method), _decide(method, decider, seen))


def recording_name(scenario: Scenario, method: Method) -> str:
    """Return the name of an episode's recording."""
    return f"{scenario.key}-{file_name(method.name)}.rrd"


def _first_look(scenario: Scenario, decider: GraspSelector) -> SharedObservation | Attempt:
    """Return what is seen from home, or the attempt that ended with the look."""
    frame, q = look(scenario.scene())
    return _see(scenario, decider, frame, q)


def _see(scenario: Scenario, decider: GraspSelector, frame: RgbdFrame, q: np.ndarray) -> SharedObservation | Attempt:
    times = StageTimes()
    try:
        return SharedObservation.by(decider, occlude(frame, scenario.occlusion, scenario.draw_seed), q, times)
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
    seen: SharedObservation,
    *,
    top_k: int,
    recordings: Recordings | None,
) -> Row:
    decider = make_grasp_selector(scenario, scenario.draw_seed)
    first = _decide(method, decider, seen)
    attempts, given_up, qpos = [first], "", None
    if first.plan is not None:
        with Robot(scenario.scene(), decider.kinematics, decider.config.speed) as robot:
            attempts, given_up = _act(scenario, method, make_grasp_selector, robot, first, top_k=top_k)
            qpos = robot.world.data.qpos.copy()
    row = make_row(scenario, method.name, attempts, top_k=top_k, given_up=given_up, qpos=qpos)
    if recordings is not None and recordings.wants(success=row["success"]):
        record(recordings.folder / recording_name(scenario, method), first)
    return row


def _act(
    scenario: Scenario, method: Method, make_grasp_selector: MakeDecider, robot: Robot, first: Attempt, *, top_k: int
) -> tuple[list[Attempt], str]:
    """Execute `first` and, after a failure, what is decided on another look; return all attempts and why it was left
    at them."""
    attempt = first
    attempts: list[Attempt] = []
    while True:
        assert attempt.plan is not None
        outcome = robot.act(attempt.plan)
        attempts.append(replace(attempt, outcome=outcome))
        if outcome.mode not in RETRIED or len(attempts) == top_k:
            return attempts, ""
        decider = make_grasp_selector(scenario, scenario.draw_seed + len(attempts))
        try:
            robot.withdraw(attempt.plan, outcome, decider.config.jaw_home)
            if len(attempts) == 1:
                robot.look()  # this robot's first frame would have the noise of the episode's first look
            found = _see(scenario, decider, *robot.look())
        except (MotionError, HalError) as error:
            return attempts, f"{Mode.STOPPED.value}: {error}"
        attempt = found if isinstance(found, Attempt) else _decide(method, decider, found)
        if attempt.plan is None:
            return attempts, f"{attempt.ended.mode.value}: {attempt.ended.detail}"


def _decide(method: Method, decider: GraspSelector, seen: SharedObservation) -> Attempt:
    """Return the attempt that `method` would make; without a plan where there is none."""
    times = StageTimes()
    times.ms |= seen.times.ms
    best_first = left = None
    try:
        best_first, left = method.order(seen, decider, times)
        plan = decider.planner.plan(best_first.candidates, seen.q, times.stage)
    except (DegenerateCloudError, NoPlanError) as error:
        rejections = error.rejections if isinstance(error, NoPlanError) else ()
        outcome = Outcome(mode=_why_no_plan(rejections), detail=str(error))
        ranked = best_first and best_first.ranked
        attempt = Attempt(times=times, outcome=outcome, seen=seen, ranked=ranked, left=left, rejections=rejections)
    else:
        ranked = best_first.ranked
        attempt = Attempt(times=times, seen=seen, ranked=ranked, left=left, plan=plan, rejections=plan.rejections)
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
    """Return the stage at which the candidate that came furthest was refused."""
    reasons = {rejection.reason for rejection in rejections}
    if reasons & {RejectionReason.PATH, RejectionReason.SELF}:
        return Mode.NO_PATH
    return Mode.NO_IK if RejectionReason.IK in reasons else Mode.NO_CANDIDATE

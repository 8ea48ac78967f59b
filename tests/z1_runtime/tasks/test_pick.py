"""Whole picks in lock-step: the real selection on a drawn can, the real servo, a mock arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.backends.replay_camera import ReplayCamera
from hal.base import z1
from hal.base.errors import HalTimeoutError, InvalidValueError, StoppedError
from hal.base.messages import RgbdFrame
from models.obb.obb import DegenerateCloudError
from tests.support.errors import raises
from tests.support.lockstep import Bench
from tests.support.tabletop_scene import frame_of
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import draw_can, make_grasp_selector
from z1_runtime.motion.executor import MotionError
from z1_runtime.perception.detector import NoDepthError, NoDetectionError
from z1_runtime.tasks.grasp_selection import GraspSelector
from z1_runtime.tasks.holding import GripperLoadedError
from z1_runtime.tasks.pick import PickTask
from z1_runtime.visualization.rerun_logger import RerunLogger

CONFIG = RuntimeConfig(detector="tabletop", generator="antipodal", n_candidates=300, hold_s=0.2, frame_timeout_s=0.5)
Q_LOOK = np.append(z1.Q_HOME, CONFIG.jaw_home)
PHASES = ["home", "look", "decide", "transfer", "approach", "close", "lift", "hold"]


class Lane(RerunLogger):
    """A logger that only keeps the names of the phases."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def log_phase(self, name: str, t_s: float) -> None:
        self.names.append(name)


class Cell:
    """An arm, a camera that shows `frame`, and a pipeline; `after` is called with the name of each phase that ended."""

    def __init__(self, selector: GraspSelector, frame: RgbdFrame, q_start: np.ndarray = Q_LOOK) -> None:
        self.bench = Bench(q_start)
        camera = ReplayCamera([frame], clock=self.bench.clock)
        camera.connect()
        self.after = lambda name: None
        self.ended: list[str] = []
        self.lane = Lane()
        self.pipeline = PickTask(
            selector=selector,
            arm=self.bench.servo,
            camera=camera,
            clock=self.bench.clock,
            logger=self.lane,
            config=CONFIG,
            on_phase=self._phase_ended,
        )

    def _phase_ended(self, phase) -> None:
        self.ended.append(phase.name)
        self.after(phase.name)

    @property
    def q(self) -> np.ndarray:
        return self.bench.servo.read_state().q


@pytest.fixture(scope="module")
def selector() -> GraspSelector:
    return make_grasp_selector(CONFIG)


@pytest.fixture(scope="module")
def can(selector) -> RgbdFrame:
    return draw_can(selector.kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA)


@pytest.mark.integration
def test_a_pick_goes_through_its_phases_and_ends_where_the_plan_does(selector, can):
    cell = Cell(selector, can)
    result = cell.pipeline.pick()
    assert cell.ended == cell.lane.names == [phase.name for phase in result.phases] == PHASES
    for before, after in zip(result.phases, result.phases[1:], strict=False):
        assert after.start_s == pytest.approx(before.start_s + before.duration_s)
    assert cell.q == pytest.approx(result.selection.plan.lift.q[-1], abs=1e-3)
    assert sum(result.rejections.values()) == len(result.selection.plan.rejections)
    assert result.stage_ms["total"] > 0.0


@pytest.mark.integration
def test_jaws_that_close_on_nothing_hold_nothing(selector, can):
    result = Cell(selector, can).pipeline.pick()
    assert not result.held
    assert result.jaw == pytest.approx(0.0, abs=1e-3)


@pytest.mark.integration
def test_jaws_that_something_keeps_open_hold_it(selector, can):
    cell = Cell(selector, can)
    cell.after = lambda name: cell.bench.mock.block(z1.N_ARM) if name == "approach" else None
    result = cell.pipeline.pick()
    assert result.held
    assert result.jaw == pytest.approx(result.selection.plan.jaw_open, abs=1e-3)
    assert abs(result.jaw_torque_nm) > CONFIG.held_torque_nm


@pytest.mark.integration
def test_the_arm_goes_home_first_and_a_second_pick_starts_from_where_the_first_ended(selector, can):
    cell = Cell(selector, can, Q_LOOK + np.array([0.3, 0.2, -0.2, 0.1, 0.0, -0.3, 0.5]))
    captured_from = []
    cell.after = lambda name: captured_from.append(cell.q) if name == "look" else None
    first, second = cell.pipeline.pick(), cell.pipeline.pick()
    for q in captured_from:
        assert q == pytest.approx(Q_LOOK, abs=2e-3)
    assert len(second.phases) == len(PHASES)
    assert second.selection.plan.rank == first.selection.plan.rank


@pytest.mark.integration
def test_a_miss_is_followed_by_another_frame_and_pick_up_to_the_attempts(selector, can):
    cell = Cell(selector, can)
    result = cell.pipeline.pick_until_held()
    assert not result.held
    assert cell.ended == PHASES * CONFIG.attempts


@pytest.mark.integration
def test_a_pick_that_holds_is_not_repeated(selector, can):
    cell = Cell(selector, can)
    cell.after = lambda name: cell.bench.mock.block(z1.N_ARM) if name == "approach" else None
    assert cell.pipeline.pick_until_held().held
    assert cell.ended == PHASES


@pytest.mark.integration
def test_a_pick_with_an_object_in_the_jaws_is_rejected_before_anything_moves(selector, can):
    cell = Cell(selector, can)
    cell.after = lambda name: cell.bench.mock.block(z1.N_ARM) if name == "approach" else None
    assert cell.pipeline.pick().held
    lifted = cell.q
    with raises(GripperLoadedError, "gripper_loaded"):
        cell.pipeline.pick_until_held()
    assert cell.ended == PHASES
    assert cell.q == pytest.approx(lifted, abs=1e-6)


@pytest.mark.integration
def test_a_pick_that_may_drop_opens_the_jaws(selector, can):
    cell = Cell(selector, can)
    cell.after = lambda name: cell.bench.mock.block(z1.N_ARM if name == "approach" else None)
    cell.pipeline.pick()
    cell.bench.mock.block(z1.N_ARM)  # the object of before, at the angle that the jaws have closed to
    cell.pipeline.pick(drop=True)
    assert cell.ended == PHASES * 2


@pytest.mark.integration
def test_an_object_that_a_miss_pushed_away_ends_the_attempts(selector, can):
    cell = Cell(selector, can)
    empty = replace(can, depth_m=np.where(can.depth_m < 0.45, 0.0, can.depth_m))

    def clear_the_table(name: str) -> None:
        if name == "lift":
            cell.pipeline.camera = ReplayCamera([empty], clock=cell.bench.clock)
            cell.pipeline.camera.connect()

    cell.after = clear_the_table
    assert not cell.pipeline.pick_until_held().held
    assert cell.ended == [*PHASES, "home", "look"]


def nothing_moved(cell: Cell) -> bool:
    cell.bench.wait(0.5)
    return bool(np.abs(cell.q - Q_LOOK).max() < 1e-3) and cell.bench.servo.status().trajectory_id == 0


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda can: frame_of(np.zeros((480, 640), np.float32)), NoDepthError),
        (lambda can: replace(can, depth_m=np.where(can.depth_m < 0.45, 0.0, can.depth_m)), NoDetectionError),
    ],
    ids=["all-zero depth", "nothing on the table"],
)
def test_a_frame_without_an_object_is_an_error_and_nothing_moves(selector, can, change, error):
    cell = Cell(selector, change(can))
    with pytest.raises(error):
        cell.pipeline.pick()
    assert nothing_moved(cell)
    assert cell.ended == ["home", "look"]
    assert cell.lane.names == ["home", "look", "decide", "decide failed"]


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((500, 3), np.nan)], ids=["empty", "NaN"])
def test_a_cloud_that_is_empty_or_not_finite_is_an_error_and_nothing_moves(selector, can, monkeypatch, points):
    segment = selector.perception.segment
    monkeypatch.setattr(selector.perception, "segment", lambda *args: replace(segment(*args), object_points=points))
    cell = Cell(selector, can)
    with pytest.raises((InvalidValueError, DegenerateCloudError)):
        cell.pipeline.pick()
    assert nothing_moved(cell)


def test_a_camera_that_shows_nothing_is_an_error_and_nothing_moves(selector, can):
    cell = Cell(selector, can)
    cell.pipeline.camera = ReplayCamera([can], clock=cell.bench.clock, loop=False)
    cell.pipeline.camera.connect()
    cell.bench.wait(0.2)
    with pytest.raises(HalTimeoutError):
        cell.pipeline.pick()
    assert nothing_moved(cell)


@pytest.mark.integration
@pytest.mark.parametrize("phase", ["transfer", "approach", "lift"])
def test_a_stop_in_any_motion_ends_the_pick_with_its_reason_and_the_arm_rests(selector, can, phase):
    cell = Cell(selector, can)
    before = PHASES[PHASES.index(phase) - 1]
    cell.after = lambda name: (
        cell.bench.at_time(0.3, lambda: cell.bench.servo.stop("red button")) if name == before else None
    )
    with pytest.raises((MotionError, StoppedError)) as caught:
        cell.pipeline.pick()
    assert "red button" in str(caught.value)
    assert cell.ended[-1] == before
    assert cell.lane.names[-2:] == [phase, f"{phase} failed"]
    cell.bench.wait(0.5)
    at_rest = cell.q
    cell.bench.wait(0.5)
    assert cell.q == pytest.approx(at_rest, abs=1e-6)
    with raises(StoppedError, "stopped"):
        cell.pipeline.pick()


@pytest.mark.integration
def test_after_a_stop_and_rearming_the_next_pick_works(selector, can):
    cell = Cell(selector, can)
    cell.after = lambda name: cell.bench.servo.stop("red button") if name == "approach" else None
    with pytest.raises(StoppedError):
        cell.pipeline.pick()
    cell.after = lambda name: None
    cell.bench.wait(0.5)
    cell.bench.servo.rearm()
    cell.bench.servo.claim("test")
    cell.bench.wait(0.1)
    result = cell.pipeline.pick()
    assert [phase.name for phase in result.phases] == PHASES

"""The public facade on the lock-step twin, on a HAL process's devices, and with objects in place of its stages."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.errors import GuardError, InvalidValueError, StoppedError
from hal.base.messages import ServoMode
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.rig import Devices, Rig, connect_rig
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from models.samplers.antipodal import AntipodalSampler
from models.types import GraspSet
from tests.support.errors import raises
from tests.support.lockstep import TickingClock
from tests.support.ports import free_tcp_port
from z1_runtime import Robot
from z1_runtime.config import RuntimeConfig
from z1_runtime.geometry.kinematics import IkFailure, Kinematics
from z1_runtime.perception.detectors.ground_truth import GroundTruthDetector
from z1_runtime.tasks.holding import GripperLoadedError


def lockstep_rig() -> Rig:
    """Return a mock arm at home with a recorded camera, on a clock that ticks in sleeps."""
    clock = TickingClock()
    return Rig(
        arm=MockArm(clock, q=np.append(z1.Q_HOME, -1.0)),
        camera=ReplayCamera(clock=clock),
        clock=clock,
        call_every_tick=clock.each_tick.append,
    )


@pytest.fixture
def robot() -> Iterator[Robot]:
    with Robot(connect_rig(lockstep_rig())) as robot:
        yield robot


# --- Motion -------------------------------------------------------------------------------------------------------


def test_move_to_joints_ends_at_rest_there_and_keeps_the_jaw(robot: Robot) -> None:
    goal = z1.Q_HOME + 0.1
    state = robot.move_to(goal)
    np.testing.assert_allclose(state.q, np.append(goal, -1.0), atol=1e-3)
    assert np.abs(state.dq).max() < 0.02
    np.testing.assert_array_equal(robot.state().q, state.q)


def test_move_to_a_pose_puts_the_pivot_there(robot: Robot) -> None:
    kinematics = Kinematics()
    T_base_pivot = kinematics.pivot(z1.Q_HOME)
    T_base_pivot[:3, 3] += [0.02, 0.03, 0.02]
    state = robot.move_to(T_base_pivot, jaw=-0.5)
    np.testing.assert_allclose(kinematics.pivot(state.q[: z1.N_ARM]), T_base_pivot, atol=2e-3)
    assert state.q[-1] == pytest.approx(-0.5, abs=1e-3)


@pytest.mark.integration
def test_home_is_the_observation_posture_and_keeps_the_jaw(robot: Robot) -> None:
    robot.move_to(z1.Q_HOME + 0.1, jaw=-0.2)
    np.testing.assert_allclose(robot.home().q, np.append(z1.Q_HOME, -0.2), atol=1e-3)
    np.testing.assert_allclose(robot.home(jaw=-1.0).q, np.append(z1.Q_HOME, -1.0), atol=1e-3)


@pytest.fixture
def loaded(robot: Robot) -> Robot:
    """The robot with an object in its jaws, at 0.5 rad."""
    robot.move_to(z1.Q_HOME, jaw=-0.5)
    mock_of(robot).block(z1.N_ARM)
    robot.move_to(z1.Q_HOME, jaw=0.0)
    return robot


def mock_of(robot: Robot) -> MockArm:
    servo = robot.arm
    assert isinstance(servo, Servo) and isinstance(servo.arm, MockArm)
    return servo.arm


@pytest.mark.integration
@pytest.mark.parametrize(
    "open_jaws",
    [
        lambda robot: robot.home(jaw=-1.0),
        lambda robot: robot.move_to(z1.Q_HOME + 0.1, jaw=-0.6),
        lambda robot: robot.move_to(robot.state().q),
        lambda robot: robot.pick(),
    ],
    ids=["home", "move_to", "the measured joints", "pick"],
)
def test_jaws_that_hold_an_object_are_not_opened(loaded: Robot, open_jaws: Callable[[Robot], object]) -> None:
    before = loaded.arm.status()
    with raises(GripperLoadedError, "gripper_loaded") as caught:
        open_jaws(loaded)
    assert "29°" in str(caught.value) and "Nm" in str(caught.value)
    assert loaded.arm.status().trajectory_id == before.trajectory_id


@pytest.mark.integration
def test_jaws_that_hold_an_object_carry_it_and_open_on_request(loaded: Robot) -> None:
    assert loaded.move_to(z1.Q_HOME + 0.05).q[z1.N_ARM] == pytest.approx(-0.5, abs=1e-3)
    mock_of(loaded).block(None)
    assert loaded.home(jaw=-1.0, drop=True).q[z1.N_ARM] == pytest.approx(-1.0, abs=1e-3)


@pytest.mark.integration
def test_jaws_closed_on_nothing_open(robot: Robot) -> None:
    robot.move_to(z1.Q_HOME, jaw=0.0)
    assert robot.home(jaw=-1.0).q[z1.N_ARM] == pytest.approx(-1.0, abs=1e-3)


def test_a_stopped_robot_rejects_a_pick_before_it_loads_the_planner(robot: Robot, monkeypatch) -> None:
    monkeypatch.setattr(robot, "_load_selector", lambda _: pytest.fail("loaded"))
    robot.stop()
    robot.clock.sleep_until(robot.clock.now_s() + 0.01)
    with raises(StoppedError, "stopped"):
        robot.pick()


def unreachable_pose() -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = [2.0, 0.0, 0.5]
    return T


@pytest.mark.parametrize(
    ("goal", "kind", "code"),
    [
        (np.full(6, 9.0), InvalidValueError, "joint_limit"),
        (np.append(z1.Q_HOME, 0.5), InvalidValueError, "joint_limit"),
        (np.full(6, np.nan), InvalidValueError, "joint_limit"),
        (np.zeros(3), InvalidValueError, "invalid_value"),
        (unreachable_pose(), IkFailure, "unreachable"),
        (np.array([0.0, 2.9, -0.05, 0.0, 0.0, 0.0]), GuardError, "table"),
    ],
    ids=["beyond the limits", "jaw beyond its limit", "not finite", "shape", "out of reach", "into the table"],
)
def test_forbidden_goal_is_rejected_before_anything_moves(
    robot: Robot, goal: np.ndarray, kind: type, code: str
) -> None:
    before = robot.arm.status()
    with raises(kind, code):
        robot.move_to(goal)
    assert robot.arm.status().trajectory_id == before.trajectory_id
    np.testing.assert_array_equal(robot.arm.status().q_command, before.q_command)


def test_rejected_goal_names_value_range_and_remedy(robot: Robot) -> None:
    with raises(InvalidValueError, "invalid_value") as caught:
        robot.move_to(np.zeros(3))
    assert "(3,)" in str(caught.value) and "allowed (6,), (7,) or (4, 4)" in str(caught.value)
    assert "Give joints or a pose" in str(caught.value)


def test_stop_latches_until_rearm(robot: Robot) -> None:
    robot.stop()
    with pytest.raises(StoppedError):
        robot.home()
    robot.clock.sleep_until(robot.clock.now_s() + 0.01)
    assert robot.arm.status().mode is ServoMode.STOPPED
    robot.rearm()
    robot.move_to(z1.Q_HOME + 0.05)


# --- Devices ------------------------------------------------------------------------------------------------------


def test_failed_connection_leaves_nothing_open() -> None:
    closed = []

    @contextmanager
    def failing() -> Iterator[Devices]:
        try:
            raise RuntimeError("no device")
            yield
        finally:
            closed.append(True)

    with pytest.raises(RuntimeError):
        Robot(failing())
    assert closed == [True]


def test_close_disconnects_the_devices_and_is_harmless_twice() -> None:
    robot = Robot(connect_rig(lockstep_rig()))
    assert robot.frame().depth_m.any()
    robot.close()
    robot.close()
    with pytest.raises(ConnectionError):
        robot.frame()


@pytest.mark.integration
def test_connected_robot_moves_over_the_bus_and_releases_the_lease() -> None:
    clock, bus = WallClock(), BusConfig(port=free_tcp_port())
    servo, camera = Servo(MockArm(clock, q=np.append(z1.Q_HOME, -1.0)), clock), ReplayCamera(clock=clock)
    servo.connect()
    camera.connect()
    with ServoThread(servo, clock), HalServer(servo, camera, clock, bus):
        with Robot.connect(bus, owner="test") as robot:
            assert robot.frame().depth_m.any()
            assert servo.status().owner == ""
            state = robot.move_to(z1.Q_HOME + 0.05)
            np.testing.assert_allclose(state.q[:6], z1.Q_HOME + 0.05, atol=5e-3)
            assert servo.status().owner.startswith("test")
        assert servo.status().owner == ""
    camera.disconnect()
    servo.disconnect()


@pytest.mark.integration
def test_import_and_simulation_load_no_planner_detector_or_generator() -> None:
    program = (
        "import sys; from z1_runtime import Robot\n"
        "with Robot.simulate() as robot: robot.state(), robot.frame(), robot.home()\n"
        "loaded = {'torch', 'rerun', 'zenoh', 'ssik', 'z1_runtime.planning.planner'} & set(sys.modules)\n"
        "assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-P", "-c", program], check=True)


# --- Picking ------------------------------------------------------------------------------------------------------


class CountingGenerator:
    """A generator that counts its calls."""

    def __init__(self) -> None:
        self._inner, self.calls = AntipodalSampler(), 0

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        self.calls += 1
        return self._inner.sample(points, n, seed)


@pytest.mark.integration
def test_pick_with_a_given_detector_and_generator_holds_the_box_and_repeats() -> None:
    results = []
    for _ in range(2):
        generator = CountingGenerator()
        with Robot.simulate(
            "box", config=RuntimeConfig(n_candidates=200), detector=GroundTruthDetector(), generator=generator
        ) as robot:
            results.append(robot.pick())
        assert generator.calls >= 2  # the warm-up's and the pick's
    first, second = results
    assert first.held
    assert (first.jaw, first.jaw_torque_nm) == (second.jaw, second.jaw_torque_nm)
    np.testing.assert_array_equal(first.selection.plan.lift.q, second.selection.plan.lift.q)


class LabelledDetector(GroundTruthDetector):
    """A detector with a list of classes."""

    classes = ("bottle",)


@pytest.mark.integration
def test_unknown_class_is_rejected_before_and_after_loading() -> None:
    config = RuntimeConfig(n_candidates=200)
    with Robot.simulate("box", config=config, detector=LabelledDetector(), generator=AntipodalSampler()) as robot:
        for _ in range(2):
            with pytest.raises(InvalidValueError):
                robot.pick("unicorn")
            assert robot.arm.status().trajectory_id == 0
            robot.warm_up()

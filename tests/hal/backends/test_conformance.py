"""One suite over every arm and every camera: the registered backends, and the servo above each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet

from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.errors import HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint
from hal.base.z1 import N_ARM, N_JOINTS, Q_MAX, Q_MIN
from tests.support.hal.conformance import ARM_CASES, CAMERA_CASES, ArmCase, CameraCase, drive


def params(cases: list[tuple[str, Callable[[], AbstractContextManager]]]) -> list[ParameterSet]:
    """Return the cases as parameters; those over Zenoh run in real time."""
    return [pytest.param(make, id=name, marks=[pytest.mark.integration] * (name == "remote")) for name, make in cases]


@pytest.fixture(params=params(ARM_CASES))
def case(request: pytest.FixtureRequest) -> Iterator[ArmCase]:
    with request.param() as made:
        yield made


@pytest.fixture
def ready(case: ArmCase) -> ArmCase:
    case.arm.connect()
    case.prepare()
    return case


@pytest.fixture(params=params(CAMERA_CASES))
def view(request: pytest.FixtureRequest) -> Iterator[CameraCase]:
    with request.param() as made:
        yield made


# --- Arms -------------------------------------------------------------------------------------------------------


def test_an_arm_satisfies_the_contract(case: ArmCase) -> None:
    assert isinstance(case.arm, Arm)


def test_an_arm_cannot_be_used_before_it_is_connected(case: ArmCase) -> None:
    with pytest.raises(NotConnectedError):
        case.arm.read_state()
    with pytest.raises(NotConnectedError):
        case.arm.send(ArmSetpoint(q=np.zeros(N_JOINTS), dq=np.zeros(N_JOINTS)))


def test_an_arm_may_be_connected_twice_and_disconnected_twice(case: ArmCase) -> None:
    case.arm.disconnect()
    case.arm.connect()
    case.arm.connect()
    assert case.arm.read_state().q.shape == (N_JOINTS,)
    case.arm.disconnect()
    case.arm.disconnect()
    with pytest.raises(NotConnectedError):
        case.arm.read_state()


def test_an_arm_can_be_connected_again_after_it_was_disconnected(case: ArmCase) -> None:
    case.arm.connect()
    case.arm.disconnect()
    case.arm.connect()
    assert np.isfinite(case.arm.read_state().q).all()


def test_the_state_has_seven_joints_and_stamps_that_rise(ready: ArmCase) -> None:
    first = ready.arm.read_state()
    ready.clock.sleep_until(ready.clock.now_s() + 0.1)
    second = ready.arm.read_state()
    for state in (first, second):
        assert state.q.shape == state.dq.shape == state.tau.shape == (N_JOINTS,)
        assert state.faults == ()
    assert 0.05 < second.stamp_s - first.stamp_s < 0.2


@pytest.mark.integration
def test_a_connected_arm_holds_still(ready: ArmCase) -> None:
    before = ready.arm.read_state().q
    ready.clock.sleep_until(ready.clock.now_s() + 0.3)
    assert np.abs(ready.arm.read_state().q - before).max() < 0.03


def test_send_returns_what_is_applied(ready: ArmCase) -> None:
    q = np.clip(ready.arm.read_state().q, Q_MIN, Q_MAX)
    applied = ready.arm.send(ArmSetpoint(q=q, dq=np.zeros(N_JOINTS)))
    assert applied.q == pytest.approx(q, abs=0.01)


@pytest.mark.integration
def test_a_setpoint_is_followed(ready: ArmCase) -> None:
    goal = np.clip(ready.arm.read_state().q, Q_MIN, Q_MAX)
    goal[0] += 0.1
    drive(ready, lambda: ArmSetpoint(q=goal, dq=np.zeros(N_JOINTS)), 1.0)
    assert ready.arm.read_state().q[0] == pytest.approx(goal[0], abs=0.02)


@pytest.mark.integration
def test_a_setpoint_beyond_the_limits_is_clipped(ready: ArmCase) -> None:
    start = np.clip(ready.arm.read_state().q, Q_MIN, Q_MAX)
    for beyond in (Q_MAX + 1.0, Q_MIN - 1.0):
        desired = start.copy()
        desired[4] = beyond[4]  # the wrist's yaw, which can go to both ends and hits nothing
        applied = drive(ready, lambda q=desired: ArmSetpoint(q=q, dq=np.zeros(N_JOINTS)), 1.5)
        assert applied[4] == pytest.approx(np.clip(desired[4], Q_MIN[4], Q_MAX[4]), abs=1e-9)
        assert ready.arm.read_state().q[4] == pytest.approx(applied[4], abs=0.03)


@pytest.mark.integration
def test_stop_makes_the_arm_hold(ready: ArmCase) -> None:
    goal = np.clip(ready.arm.read_state().q, Q_MIN, Q_MAX)
    goal[0] += 2.0
    drive(ready, lambda: ArmSetpoint(q=goal, dq=np.zeros(N_JOINTS)), 0.01)
    ready.arm.stop()
    ready.clock.sleep_until(ready.clock.now_s() + 0.5)
    held = ready.arm.read_state().q
    assert abs(held[0] - goal[0]) > 0.3
    ready.clock.sleep_until(ready.clock.now_s() + 0.5)
    assert np.abs(ready.arm.read_state().q - held)[:N_ARM].max() < 0.01


@pytest.mark.integration
def test_a_stopped_arm_can_be_moved_again(ready: ArmCase) -> None:
    ready.arm.stop()
    ready.clock.sleep_until(ready.clock.now_s() + 0.1)
    ready.revive()
    goal = np.clip(ready.arm.read_state().q, Q_MIN, Q_MAX)
    goal[0] += 0.1
    drive(ready, lambda: ArmSetpoint(q=goal, dq=np.zeros(N_JOINTS)), 1.0)
    assert ready.arm.read_state().q[0] == pytest.approx(goal[0], abs=0.02)


# --- Cameras ------------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_camera_satisfies_the_contract(view: CameraCase) -> None:
    view.camera.connect()
    assert isinstance(view.camera, Camera)


def test_a_camera_cannot_be_used_before_it_is_connected(view: CameraCase) -> None:
    with pytest.raises(NotConnectedError):
        view.camera.wait_for_frame(0.1)
    with pytest.raises(NotConnectedError):
        _ = view.camera.intrinsics


@pytest.mark.integration
def test_a_camera_may_be_connected_twice_and_disconnected_twice(view: CameraCase) -> None:
    view.camera.disconnect()
    view.camera.connect()
    view.camera.connect()
    view.camera.wait_for_frame(1.0)
    view.camera.disconnect()
    view.camera.disconnect()
    with pytest.raises(NotConnectedError):
        view.camera.wait_for_frame(0.1)


@pytest.mark.integration
def test_frames_count_up_and_are_exposed_after_the_call(view: CameraCase) -> None:
    view.camera.connect()
    last = None
    for _ in range(4):
        called_s = view.clock.now_s()
        frame = view.camera.wait_for_frame(1.0)
        assert called_s - 1e-9 <= frame.stamp_s <= view.clock.now_s() + 1e-9
        if last is not None:
            assert frame.sequence > last.sequence
            assert frame.stamp_s > last.stamp_s
        last = frame


@pytest.mark.integration
def test_a_frame_matches_the_intrinsics_and_is_plausible(view: CameraCase) -> None:
    view.camera.connect()
    frame = view.camera.wait_for_frame(1.0)
    assert frame.intrinsics == view.camera.intrinsics
    size = (frame.intrinsics.height, frame.intrinsics.width)
    assert frame.colour.shape == (*size, 3)
    assert frame.depth_m.shape == size
    assert frame.depth_m.min() >= 0
    assert (frame.depth_m > 0).mean() > 0.2


@pytest.mark.integration
def test_a_frame_is_read_only(view: CameraCase) -> None:
    view.camera.connect()
    frame = view.camera.wait_for_frame(1.0)
    for array in (frame.colour, frame.depth_m):
        assert not array.flags.writeable


@pytest.mark.integration
def test_a_frame_that_does_not_come_in_time_is_an_error(view: CameraCase) -> None:
    view.camera.connect()
    view.camera.wait_for_frame(1.0)
    with pytest.raises(HalTimeoutError):
        view.camera.wait_for_frame(0.001)

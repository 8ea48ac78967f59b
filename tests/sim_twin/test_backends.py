import threading
from collections.abc import Iterator

import numpy as np
import pytest

from hal.base import z1
from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import ManualClock, WallClock
from hal.base.errors import HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, RgbdFrame
from hal.rig import ARMS, CAMERAS, RIGS, Rig
from sim_twin.backends import TwinArm, TwinCamera, TwinClock, make_rig
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.errors import raises


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = make_rig(SceneConfig(object="cylinder"), lockstep=True)
    rig.arm.connect()
    rig.camera.connect()
    yield rig
    rig.camera.disconnect()
    rig.arm.disconnect()


@pytest.mark.integration
def test_the_registry_makes_the_twin_by_name_and_it_keeps_the_contracts() -> None:
    assert isinstance(ARMS.make("sim"), TwinArm)
    assert isinstance(CAMERAS.make("sim"), TwinCamera)
    for lockstep in (True, False):
        rig = RIGS.make("sim", lockstep=lockstep)
        assert isinstance(rig.arm, Arm)
        assert isinstance(rig.clock, TwinClock if lockstep else WallClock)
        assert (rig.call_every_tick is not None) == lockstep
        assert isinstance(rig.world, World)


def _episode(seed: int) -> list[bytes]:
    rig = make_rig(SceneConfig(object="box", pitch_deg=15.0, seed=seed), lockstep=True)
    rig.arm.connect()
    rig.camera.connect()
    record = []
    start = rig.arm.read_state().q

    def tick() -> None:
        t_s = rig.clock.now_s()
        offset = 0.4 * np.sin(t_s) * np.array([1, -1, 0, 0, 1, 0, 0])
        rig.arm.send(ArmSetpoint(q=start + offset, dq=0.4 * np.cos(t_s) * np.array([1, -1, 0, 0, 1, 0, 0])))
        state = rig.arm.read_state()
        record.append(state.q.tobytes() + state.dq.tobytes() + state.tau.tobytes())

    assert rig.call_every_tick is not None
    rig.call_every_tick(tick)
    for _ in range(4):
        frame = rig.camera.wait_for_frame(1.0)
        assert frame.ground_truth_mask is not None
        record.append(frame.colour.tobytes() + frame.depth_m.tobytes() + frame.ground_truth_mask.tobytes())
        record.append(np.array([frame.stamp_s, frame.sequence]).tobytes())
    rig.camera.disconnect()
    return record


@pytest.mark.integration
def test_the_same_seed_and_calls_give_the_same_bytes_and_another_seed_other_noise() -> None:
    first, again, other = _episode(0), _episode(0), _episode(1)
    assert first == again
    assert len(first) == len(other)
    assert first != other


@pytest.mark.integration
def test_frames_come_thirty_times_a_second_and_count_up(rig: Rig) -> None:
    frames = [rig.camera.wait_for_frame(0.1) for _ in range(4)]
    assert [frame.sequence for frame in frames] == [1, 2, 3, 4]
    for number, frame in enumerate(frames, start=1):
        assert 0 <= frame.stamp_s - number / 30 <= z1.CONTROL_PERIOD_S


@pytest.mark.integration
def test_a_frame_holds_colour_depth_and_the_objects_mask(rig: Rig) -> None:
    assert isinstance(rig.camera, Camera)
    frame: RgbdFrame = rig.camera.wait_for_frame(0.1)
    assert frame.colour.shape == (480, 640, 3)
    assert frame.intrinsics == rig.camera.intrinsics
    assert frame.ground_truth_mask is not None
    inside, valid = frame.depth_m[frame.ground_truth_mask], frame.depth_m > 0
    assert 0.85 < (inside > 0).mean() < 1.0  # the real one has holes
    assert np.median(inside[inside > 0]) == pytest.approx(0.35, abs=0.05)
    assert 0.5 < valid.mean() < 0.95
    red = frame.colour[frame.ground_truth_mask].mean(axis=0)
    assert red[0] > 1.5 * red[2]  # the cylinder is red


@pytest.mark.integration
def test_without_noise_depth_is_whole_and_colour_clean() -> None:
    camera = TwinCamera(World(SceneConfig(object="cylinder", noise=False)))
    camera.connect()
    first, second = camera.wait_for_frame(0.1), camera.wait_for_frame(0.1)
    camera.disconnect()
    assert first.ground_truth_mask is not None
    assert (first.depth_m[first.ground_truth_mask] > 0).all()
    # The object settles by micrometres between the frames: a pixel of its rim may differ.
    assert (first.colour != second.colour).mean() < 1e-4


@pytest.mark.integration
def test_no_time_for_a_frame_is_a_timeout_that_says_how_long_to_wait(rig: Rig) -> None:
    before = rig.clock.now_s()
    with raises(HalTimeoutError, "timeout"):
        rig.camera.wait_for_frame(0.01)
    assert rig.clock.now_s() == pytest.approx(before + 0.01)


@pytest.mark.integration
def test_nothing_works_before_connect_and_disconnect_is_harmless() -> None:
    arm, camera = TwinArm(), TwinCamera()
    arm.disconnect()
    camera.disconnect()
    with pytest.raises(NotConnectedError):
        arm.read_state()
    with pytest.raises(NotConnectedError):
        arm.send(ArmSetpoint(q=np.zeros(7), dq=np.zeros(7)))
    with pytest.raises(NotConnectedError):
        camera.wait_for_frame(1.0)
    with pytest.raises(NotConnectedError):
        _ = camera.intrinsics


@pytest.mark.integration
def test_send_clamps_as_the_vendors_controller_does_and_says_so(rig: Rig) -> None:
    applied = rig.arm.send(ArmSetpoint(q=np.full(7, 9.0), dq=np.full(7, -50.0)))
    np.testing.assert_array_equal(applied.q, z1.Q_MAX)
    np.testing.assert_array_equal(applied.dq, -z1.DQ_MAX)


@pytest.mark.integration
def test_stop_holds_where_the_arm_is(rig: Rig) -> None:
    q = rig.arm.read_state().q
    rig.arm.send(ArmSetpoint(q=q + 0.5 * np.eye(7)[0], dq=np.zeros(7)))
    rig.clock.sleep_until(0.1)
    rig.arm.stop()
    held = rig.arm.read_state().q
    rig.clock.sleep_until(1.0)
    assert 0.01 < held[0] < 0.45
    np.testing.assert_allclose(rig.arm.read_state().q, held, atol=0.05)
    np.testing.assert_allclose(rig.arm.read_state().dq, 0.0, atol=1e-3)


@pytest.mark.integration
def test_in_lock_step_reading_moves_nothing(rig: Rig) -> None:
    for _ in range(10):
        assert rig.arm.read_state().stamp_s == 0.0


def test_in_real_time_reading_drives_the_world_and_drops_what_is_too_late() -> None:
    clock, world = ManualClock(100.0), World(SceneConfig(object="cylinder"))
    arm = TwinArm(world, clock)
    arm.connect()
    clock.advance(0.0101)
    assert arm.read_state().stamp_s == pytest.approx(100.010)
    assert world.time_s == pytest.approx(0.010)
    clock.advance(1.0)
    state = arm.read_state()
    assert world.time_s <= 0.030 + 1e-9  # 20 ms made up, the rest dropped
    assert clock.now_s() - state.stamp_s < 0.0021
    clock.advance(0.002)
    arm.read_state()
    assert world.time_s <= 0.032 + 1e-9


@pytest.mark.integration
def test_the_camera_may_be_read_from_another_thread_than_it_was_opened_in(rig: Rig) -> None:
    frames: list[RgbdFrame] = []
    thread = threading.Thread(target=lambda: frames.append(rig.camera.wait_for_frame(1.0)))
    thread.start()
    thread.join()
    assert len(frames) == 1
    assert frames[0].colour.std() > 10


@pytest.mark.integration
def test_two_cameras_may_draw_at_the_same_time() -> None:
    cameras = [TwinCamera(World(SceneConfig(object=name, noise=False))) for name in ("box", "cylinder")]
    for camera in cameras:
        camera.connect()
    frames = [camera.wait_for_frame(0.1) for _ in range(2) for camera in cameras]
    for camera in cameras:
        camera.disconnect()
    for first, second in ((0, 2), (1, 3)):
        assert (frames[first].colour != frames[second].colour).mean() < 1e-4
    assert (frames[0].colour != frames[1].colour).mean() > 0.01

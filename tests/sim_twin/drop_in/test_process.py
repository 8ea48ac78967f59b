"""Rig `wire-sim`: world and controller in one process, optics in another, both real drivers in this one."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from hal.backends.d405.session import D405CameraConfig
from hal.backends.z1.config import Z1Mode
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.d405 import CaptureRequest
from hal.base.errors import HalError, LeaseError
from hal.base.messages import ArmSetpoint
from hal.rig import RIGS
from hal.z1_protocol.records import MotorError
from sim_twin.drop_in.camera_process import RemoteSource
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.process import WireProcess
from sim_twin.drop_in.realsense_source import TwinSource
from sim_twin.drop_in.rig import WireSimArm, WireSimCamera, free_ports
from sim_twin.drop_in.shared_memory import SharedWorld, make_memory
from sim_twin.ground_truth import read_ground_truth
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.errors import raises

pytestmark = pytest.mark.integration
needs_librealsense = pytest.mark.skipif(find_spec("pyrealsense2") is None, reason="pyrealsense2 has no wheel here")
REST = np.zeros(z1.N_JOINTS)


def make_process(scene: SceneConfig | None = None) -> WireProcess:
    command_port, state_port = free_ports()
    wire = WireConfig(command_port=command_port, state_port=state_port)
    return WireProcess(scene or SceneConfig(noise=False), wire)


@pytest.fixture(scope="module")
def twin() -> Iterator[WireProcess]:
    twin = make_process()
    yield twin
    twin.close()


def await_true(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    clock = WallClock()
    end_s = clock.now_s() + timeout_s
    while not condition():
        assert clock.now_s() < end_s
        clock.sleep_until(clock.now_s() + 0.005)


# --- Shared memory --------------------------------------------------------------------------------------------------


def test_published_poses_are_read_and_torn_ones_rejected() -> None:
    fd = make_memory(SharedWorld.SIZE)
    writer, reader = SharedWorld(fd), SharedWorld(fd)
    writer.publish(1.5, np.arange(14.0))
    time_s, qpos = reader.read()
    assert time_s == 1.5
    assert qpos == pytest.approx(np.arange(14.0))
    writer._version += 1  # as if it had ended during a write
    with raises(HalError, "torn_write"):
        reader.read()
    writer.publish(2.5, np.ones(7))  # by its successor
    assert reader.read()[0] == 2.5
    assert reader.read()[1] == pytest.approx(np.ones(7))
    os.close(fd)


# --- World and controller -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_the_real_driver_moves_the_twin(twin: WireProcess, mode: Z1Mode) -> None:
    arm = WireSimArm(twin, WallClock(), mode)
    arm.connect()
    goal = np.clip(arm.read_state().q, z1.Q_MIN, z1.Q_MAX)
    goal[0] += 0.3

    def reach_goal() -> bool:
        arm.send(ArmSetpoint(q=goal, dq=REST))
        return abs(arm.read_state().q[0] - goal[0]) < 0.02

    await_true(reach_goal)
    assert arm.read_state().faults == ()
    assert twin.poses()[1][0] == pytest.approx(goal[0], abs=0.03)
    arm.disconnect()
    assert twin.running  # as a real controller does without a client


def test_the_real_driver_reads_the_twins_faults(twin: WireProcess) -> None:
    arm = WireSimArm(twin, WallClock())
    arm.connect()
    twin.error[1, 1] = MotorError.OVERHEAT
    await_true(lambda: "joint2 motor 2: overheat" in arm.read_state().faults)
    twin.error[:] = 0
    arm.disconnect()


def test_the_ground_truth_is_read_from_this_process(twin: WireProcess) -> None:
    truth = read_ground_truth(twin)
    assert truth.object == "bottle"
    assert truth.lifted_m == pytest.approx(0.0, abs=1e-3)
    assert truth.T_base_object[0, 3] == pytest.approx(0.48, abs=0.01)
    assert twin.model.nq == len(truth.qpos) == 14
    assert twin.statistics()["answers"] > 0


def test_a_port_in_use_is_reported(twin: WireProcess) -> None:
    twin.start()
    with raises(LeaseError, "port_in_use"):
        WireProcess(twin.config, twin.wire).start()


# --- The camera -----------------------------------------------------------------------------------------------------


@needs_librealsense
def test_the_real_camera_driver_renders_the_world_of_the_other_process(twin: WireProcess) -> None:
    camera = WireSimCamera(twin, D405CameraConfig(warm_up_s=0.0))
    camera.connect()
    frame = camera.wait_for_frame(10.0)
    camera.disconnect()
    centre = frame.depth_m[200:400, 250:400]
    assert frame.serial == "twin"
    assert 0.15 < np.median(centre[centre > 0]) < 0.5
    assert frame.colour.std() > 10


def test_images_are_transferred_unchanged() -> None:
    world, memory, model = World(SceneConfig()), make_memory(SharedWorld.SIZE), make_memory(0)
    SharedWorld(memory).publish(*world.poses())
    os.write(model, pickle.dumps(world.model))
    still = cast(WireProcess, SimpleNamespace(config=world.config, memory=memory, model_file=model))
    request = CaptureRequest(number=7, width=424, height=240, depth=True, colour=True, left=True, right=True)
    remote = RemoteSource(still)
    transferred = remote.expose(request)
    with TwinSource(world, WallClock()) as source:
        local = source.expose(request)
    for name in ("depth", "colour", "left", "right"):
        np.testing.assert_array_equal(getattr(transferred, name), getattr(local, name))
    assert transferred.number == 7
    only = remote.expose(CaptureRequest(number=8, width=640, height=480, depth=True))
    assert only.depth is not None
    assert only.depth.shape == (480, 640)
    assert only.colour is None
    remote.close()


def test_the_rig_is_registered_and_starts_nothing_yet() -> None:
    rig = RIGS.make("wire-sim", scene=SceneConfig(object="box"))
    assert isinstance(rig.arm, WireSimArm)
    assert isinstance(rig.camera, WireSimCamera)
    assert rig.world.config.object == "box"
    assert not rig.world.running
    assert rig.call_every_tick is None
    rig.arm.disconnect()


def test_worlds_of_both_processes_start_alike(twin: WireProcess) -> None:
    world = World(SceneConfig(noise=False))
    assert twin.start_height_m == world.start_height_m


def test_the_driver_reports_a_killed_controller(twin: WireProcess) -> None:
    arm = WireSimArm(twin, WallClock())
    arm.connect()
    assert twin._child is not None
    os.kill(twin._child.pid, signal.SIGKILL)
    await_true(lambda: not twin.running)
    clock = WallClock()
    with raises(HalError, "process_ended") as caught:
        while True:
            arm.read_state()
            clock.sleep_until(clock.now_s() + 0.01)
    assert "the twin's controller was killed by signal 9" in str(caught.value)
    arm.disconnect()
    with raises(HalError, "process_ended"):
        twin.statistics()
    twin.close()

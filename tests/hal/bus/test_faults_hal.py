"""A HAL process killed in motion, with the real Z1's driver in it and the twin's controller outside."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from hal.backends.z1.config import Z1ArmConfig
from hal.backends.z1.keeper.owner import take_over
from hal.base import z1
from hal.base.errors import HalTimeoutError
from hal.bus.client import RemoteArm
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.rig import free_ports
from sim_twin.drop_in.udp_server import WireServer
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.faults_table import FaultsTable
from tests.support.hal.bus_hal import end_processes, free_config, moving, set_off, start_python, wait_until

pytestmark = pytest.mark.integration

SERVE = """
import sys
from threading import Event
from hal.backends.replay_camera import ReplayCamera
from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig
from hal.bus.session import BusConfig
from hal.base.clock import WallClock
from hal.process import serve
from hal.rig import Rig
port, command_port, state_port = map(int, sys.argv[1:])
clock = WallClock()
arm = Z1Arm(clock, Z1ArmConfig(command_port=command_port, state_port=state_port))
rig = Rig(arm=arm, camera=ReplayCamera(clock=clock), clock=clock)
serve(rig, BusConfig(port=port), Event(), on_ready=lambda: print("ready", flush=True))
"""


class WatchedWorld(World):
    """Keeps its time and its joints after every step."""

    def __init__(self) -> None:
        self.steps: list[tuple[float, np.ndarray, np.ndarray]] = []
        super().__init__(SceneConfig())

    def step(self) -> None:
        super().step()
        q, dq, _ = self.read_arm()
        self.steps.append((self.time_s, q, dq))


@pytest.mark.faults
def test_a_killed_hal_leaves_an_arm_that_holds(faults_table: FaultsTable) -> None:
    config = free_config(connect_timeout_s=30.0)
    command_port, state_port = free_ports()
    world = WatchedWorld()
    hal = None
    wire = WireConfig(command_port=command_port, state_port=state_port)
    with WireServer(ControlledWorld(world), wire):
        try:
            hal = start_python(SERVE, config.port, command_port, state_port)
            assert hal.stdout is not None
            assert hal.stdout.readline() == "ready\n"
            with RemoteArm(config) as arm:
                arm.claim()
                wait_until(lambda: moving(arm) or set_off(arm), 60.0)
                killed_s, q, _ = world.steps[-1]
                hal.send_signal(signal.SIGKILL)
                wait_until(lambda: world.time_s > killed_s + 1.0, 60.0)
                with pytest.raises(HalTimeoutError) as caught:
                    arm.read_state()
        finally:
            end_processes(hal)
            take_over((Z1ArmConfig().local_host, state_port))
    after = [step for step in world.steps if step[0] > killed_s]
    moving_s = [t_s for t_s, _, dq in after if np.abs(dq[: z1.N_ARM]).max() > 0.02]
    further = np.abs(after[-1][1] - q)[: z1.N_ARM].max()
    assert further < 0.1
    faults_table.add(
        "HAL killed (real driver, twin's controller)",
        arm=f"holds; joint1 {1e3 * further:.0f} mrad further",
        rest_s=max(moving_s, default=killed_s) - killed_s,
        reads=caught.value,
    )

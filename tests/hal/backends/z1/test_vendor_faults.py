"""Properties of the vendor's controller that hurt an arm whose driver does not know them, on the twin's controller."""

from __future__ import annotations

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.errors import CommandRejectedError
from hal.z1_protocol.states import Fsm
from sim_twin.controller.client_port import WATCHDOG_TIMEOUTS
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.rig import free_ports
from sim_twin.drop_in.udp_server import WireServer
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.hal.wire_bench import WireBench

_UNANSWERED = 2  # commands that may be on their way to a controller that reads one a cycle
_MOVED_RAD = 0.05
_SETTLE_S = 0.5


def hold(bench: WireBench, duration_s: float) -> list[int]:
    """Tick the servo for `duration_s` [s]; return the controller's backlog after each tick."""
    backlog = []
    for _ in range(round(duration_s / z1.CONTROL_PERIOD_S)):
        bench.servo.tick()
        bench.clock.sleep_until(bench.clock.now_s() + z1.CONTROL_PERIOD_S)
        backlog.append(bench.twin.port.backlog)
    return backlog


@pytest.mark.integration
@pytest.mark.parametrize("leave", ["enter", "disconnect"])
def test_leaving_low_level_moves_nothing(leave: str) -> None:
    """The controller obeys the body of a state request for a cycle, and then starts from it."""
    bench = WireBench(Z1Mode.LOW_LEVEL)
    hold(bench, 0.1)
    before = bench.world.read_arm()[0]
    moved = np.zeros(z1.N_ARM)

    def record() -> None:
        np.maximum(moved, np.abs(bench.world.read_arm()[0] - before)[: z1.N_ARM], out=moved)

    bench.twin_clock.call_every_tick(record)
    if leave == "enter":
        bench.arm.enter(Z1Mode.TRACKING)
    else:
        bench.arm.disconnect()
    bench.twin_clock.sleep_until(bench.twin_clock.now_s() + _SETTLE_S)
    assert bench.twin.controller.fsm is Fsm.JOINTCTRL
    assert moved.max() < _MOVED_RAD


@pytest.mark.integration
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_the_commands_never_queue_up(mode: Z1Mode) -> None:
    """The controller reads one datagram a cycle; every further one delays all later commands by a cycle."""
    bench = WireBench(mode)
    assert max(hold(bench, 3.0)) <= _UNANSWERED
    assert bench.twin.port.dropped == 0


@pytest.mark.integration
def test_an_idle_owner_does_not_let_the_arm_sink() -> None:
    """The controller goes to PASSIVE after 2.2 s without a datagram, as while a program loads."""
    command_port, state_port = free_ports()
    world = World(SceneConfig())
    twin = ControlledWorld(world)
    clock = WallClock()
    arm = Z1Arm(clock, Z1ArmConfig(command_port=command_port, state_port=state_port))
    with WireServer(twin, WireConfig(command_port=command_port, state_port=state_port)):
        arm.connect()
        before, since_s = world.read_arm()[0], world.time_s
        while world.time_s < since_s + 0.15 * WATCHDOG_TIMEOUTS:
            clock.sleep_until(clock.now_s() + 0.05)
        assert twin.controller.fsm is Fsm.JOINTCTRL
        assert np.abs(world.read_arm()[0] - before)[: z1.N_ARM].max() < _MOVED_RAD
        arm.disconnect()


def test_an_unknown_label_is_not_reported_as_done() -> None:
    bench = WireBench()
    with pytest.raises(CommandRejectedError):
        bench.arm.run_label("nowhere")

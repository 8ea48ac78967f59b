"""The keeper against the vendor's controller, on a stepped clock: an arm is held while its driver is silent or gone."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.backends.z1.keeper.holding import PERIOD_S, SILENCE_S, Keeper, Phase
from hal.backends.z1.keeper.page import Page, make_page_file
from hal.base import z1
from hal.base.clock import ManualClock
from hal.base.messages import ArmSetpoint
from hal.z1_protocol.controller import encode_command
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm
from tests.support.hal.vendor_controller import WATCHDOG_S, VendorController, VendorLink

REST = np.zeros(z1.N_JOINTS)


class Bench:
    """A driver and its keeper on one link; the keeper steps only in `idle`, while the driver does nothing."""

    def __init__(self, mode: Z1Mode = Z1Mode.TRACKING) -> None:
        self.clock = ManualClock(10.0)
        self.peer = VendorController(10.0)
        self.link = VendorLink(self.peer, self.clock)
        self.arm = Z1Arm(self.clock, Z1ArmConfig(mode=mode), link=self.link)
        fd = make_page_file()
        page = Page(fd)
        self.keeper = Keeper(self.link, Page(fd), self.clock.now_s())
        os.close(fd)
        self.arm._client.publish = page.record
        self.arm.connect()

    def run(self, duration_s: float, q: np.ndarray | None = None) -> None:
        goal = self.arm.read_state().q if q is None else q
        for _ in range(round(duration_s / z1.CONTROL_PERIOD_S)):
            self.arm.read_state()
            self.arm.send(ArmSetpoint(q=goal, dq=REST))
            self.keeper.step(self.clock.now_s())
            self.clock.advance(z1.CONTROL_PERIOD_S)

    def idle(self, duration_s: float) -> float:
        """Let only the keeper run; return the maximum deviation of a joint [rad] meanwhile."""
        before, worst = self.peer.q.copy(), 0.0
        for _ in range(round(duration_s / 0.01)):
            self.clock.advance(0.01)
            self.keeper.step(self.clock.now_s())
            self.peer.advance(self.clock.now_s())
            worst = max(worst, float(np.abs(self.peer.q - before).max()))
        return worst


@pytest.fixture(params=[Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    yield Bench(request.param)


def test_without_a_keeper_a_silent_driver_lets_the_arm_sink(bench: Bench) -> None:
    bench.run(0.1)
    bench.clock.advance(WATCHDOG_S + 0.5)
    bench.peer.advance(bench.clock.now_s())
    assert bench.peer.fsm is Fsm.PASSIVE


@pytest.mark.integration
def test_a_silent_driver_is_stood_in_for_and_goes_on_afterwards(bench: Bench) -> None:
    bench.run(0.3)
    state = bench.peer.fsm
    assert bench.keeper.stepped_in == 0
    assert bench.idle(3 * WATCHDOG_S) < 0.01
    assert bench.peer.fsm is state
    assert bench.keeper.stepped_in > (2 * WATCHDOG_S - SILENCE_S) / PERIOD_S
    stood_in = bench.keeper.stepped_in
    bench.run(0.3)
    assert bench.arm.read_state().faults == ()
    assert bench.keeper.stepped_in == stood_in


@pytest.mark.integration
def test_a_driver_that_ends_in_motion_leaves_an_arm_that_is_held(bench: Bench) -> None:
    goal = bench.arm.read_state().q.copy()
    goal[0] += 1.0
    bench.run(0.3, goal)
    bench.keeper.end_owner(bench.clock.now_s())
    assert bench.keeper.phase is Phase.HOLDING
    assert bench.idle(3 * WATCHDOG_S) < 0.05
    assert bench.peer.fsm is Fsm.JOINTCTRL


@pytest.mark.integration
@pytest.mark.parametrize("end", ["killed", "silent"])
def test_a_torque_without_stiffness_ends_with_its_driver(end: str) -> None:
    bench = Bench(Z1Mode.LOW_LEVEL)
    push = JointCommands(tau=np.eye(z1.N_JOINTS)[0] * 5.0)
    for _ in range(20):
        bench.arm.read_state()
        bench.arm.send_motors(push)
        bench.clock.advance(z1.CONTROL_PERIOD_S)
    if end == "killed":
        bench.keeper.end_owner(bench.clock.now_s())
    bench.idle(1.0)
    assert bench.peer.fsm is (Fsm.JOINTCTRL if end == "killed" else Fsm.LOWCMD)
    assert bench.idle(WATCHDOG_S) < 0.01


def test_a_motion_of_the_controller_ends_with_its_driver() -> None:
    bench = Bench()
    bench.arm.begin_move(Fsm.TOSTATE, "forward")
    bench.keeper.end_owner(bench.clock.now_s())
    bench.idle(0.1)
    assert bench.peer.fsm is Fsm.JOINTCTRL
    assert bench.idle(WATCHDOG_S) < 0.01


def test_a_grip_is_kept(bench: Bench) -> None:
    bench.peer.stuck = 6
    bench.arm.grip(2.0)
    bench.run(0.1)
    bench.keeper.end_owner(bench.clock.now_s())
    bench.idle(1.0)
    lead = bench.peer.target[6] - bench.peer.q[6]
    assert lead * z1.KP[6] == pytest.approx(2.0, abs=0.3)


def test_a_release_lets_the_arm_sink_and_ends_the_keeper(bench: Bench) -> None:
    bench.run(0.1)
    bench.keeper.release()
    assert bench.keeper.phase is Phase.STANDBY  # the driver runs
    bench.keeper.end_owner(bench.clock.now_s())
    bench.idle(0.2)
    bench.keeper.release()
    bench.idle(0.5)
    assert bench.peer.fsm is Fsm.PASSIVE
    assert bench.keeper.phase is Phase.ENDED


@pytest.mark.integration
@pytest.mark.parametrize("gone", ["limp", "silent"])
def test_the_keeper_ends_when_there_is_nothing_to_hold(gone: str) -> None:
    bench = Bench()
    bench.run(0.1)
    bench.keeper.end_owner(bench.clock.now_s())
    bench.idle(0.2)
    if gone == "limp":
        bench.peer.fsm = Fsm.PASSIVE
    else:
        bench.peer.mute = True
    bench.idle(6.0)
    assert bench.keeper.phase is Phase.ENDED
    assert ("PASSIVE" if gone == "limp" else "has not answered") in bench.keeper.reason


def test_a_page_keeps_the_last_posture_and_counts_all_commands() -> None:
    fd = make_page_file()
    page, other = Page(fd), Page(fd)
    os.close(fd)
    assert other.command() is None
    data = encode_command(Fsm.INVALID, JointCommands(q=np.arange(7.0)))
    page.record(data)
    page.record(b"")
    assert (other.count(), other.command()) == (2, data)

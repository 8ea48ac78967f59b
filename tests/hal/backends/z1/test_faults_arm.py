"""Faults of the arm and of its controller: the arm's reaction, its duration, and the operator's message."""

from __future__ import annotations

import pytest

from hal.backends.z1.config import Z1Mode
from hal.base import z1
from hal.base.messages import ServoMode
from hal.z1_protocol.controller import encode_command
from hal.z1_protocol.records import MotorError, MotorLink
from hal.z1_protocol.states import Fsm
from tests.support.faults_table import FaultsTable
from tests.support.hal.wire_bench import WireBench

pytestmark = pytest.mark.faults


@pytest.mark.integration
@pytest.mark.parametrize(
    ("motor", "field", "value"),
    [
        ((0, 0), "error", MotorError.OVER_CURRENT),
        ((1, 0), "error", MotorError.LEAKAGE),
        ((1, 1), "error", MotorError.OVERHEAT),
        ((2, 0), "error", MotorError.PARAMETER_JUMP),
        ((3, 0), "link", MotorLink.LOST),
        ((4, 0), "link", MotorLink.CRC_ERROR),
    ],
)
def test_a_motors_fault_bit(
    motor: tuple[int, int], field: str, value: MotorError | MotorLink, faults_table: FaultsTable
) -> None:
    bench = WireBench()
    bench.play(lambda: getattr(bench.twin.motors, field).__setitem__(motor, value))
    bench.assert_safe()
    assert bench.status.mode is ServoMode.STOPPED
    assert z1.JOINT_NAMES[motor[0]] in bench.status.reason
    bench.report(faults_table, f"motor {field} bit {value.name.lower().replace('_', ' ')}")


@pytest.mark.integration
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_a_motor_board_that_falls_silent(mode: Z1Mode, faults_table: FaultsTable) -> None:
    bench = WireBench(mode)
    bench.play(lambda: setattr(bench.twin.motors, "silent", True))
    bench.assert_safe()
    assert bench.status.mode is ServoMode.STOPPED
    # Both are true of it; the one that is found first depends on the delay of the commands
    assert any(text in bench.status.reason for text in ("repeated one measurement", "does not follow"))
    bench.report(faults_table, f"motor board silent ({mode})")


@pytest.mark.integration
@pytest.mark.parametrize("mode", [Z1Mode.TRACKING, Z1Mode.LOW_LEVEL])
def test_a_controller_without_answers(mode: Z1Mode, faults_table: FaultsTable) -> None:
    bench = WireBench(mode)
    bench.play(lambda: setattr(bench.link, "mangle", lambda data: []))
    bench.assert_safe()
    assert bench.status.mode is ServoMode.STOPPED
    assert "has not answered" in bench.status.reason
    bench.report(faults_table, f"controller ended, or its cable unplugged ({mode})")


@pytest.mark.integration
def test_a_controller_switched_by_another_program(faults_table: FaultsTable) -> None:
    bench = WireBench()

    def request_three_times() -> None:  # of two datagrams in 4 ms the controller obeys the newer one, which is ours
        for _ in range(3):
            bench.twin.receive(encode_command(Fsm.CARTESIAN))

    bench.play(request_three_times)
    bench.assert_safe()
    assert bench.status.mode is ServoMode.STOPPED
    assert "from JOINTCTRL to CARTESIAN without a request" in bench.status.reason
    bench.report(faults_table, "controller switched by another program")


@pytest.mark.integration
def test_a_clock_that_jumps(faults_table: FaultsTable) -> None:
    bench = WireBench()
    bench.play(lambda: setattr(bench.clock, "ahead_s", 3600.0))
    bench.assert_safe()
    assert bench.status.mode is not ServoMode.TRACKING
    bench.report(faults_table, "clock jumps by 1 h, as after a suspend")


@pytest.mark.integration
def test_a_push_that_is_stronger_than_a_motor(faults_table: FaultsTable) -> None:
    push_nm, push_s = 33.0, 0.3
    bench = WireBench()

    def push() -> None:
        pushing = bench.world.time_s < bench.fault_s + push_s
        bench.world.data.qfrc_applied[0] = -push_nm if pushing else 0.0

    bench.play(lambda: bench.twin_clock.call_every_tick(push))
    bench.assert_safe()
    assert bench.status.mode is ServoMode.STOPPED
    assert bench.status.reason.startswith("joint1")
    bench.report(faults_table, f"joint1 pushed back with {push_nm:.0f} Nm for {push_s:.1f} s")

"""Measure the latency of commands to the Z1's controller, the twin's or one that runs on this machine.

    .venv/bin/python -m scripts.measure.measure_z1_latency --seconds 60
    .venv/bin/python -m scripts.measure.measure_z1_latency --address 127.0.0.1:8071:8072    # holds that arm

The servo streams setpoints at 500 Hz over UDP. The step latency is independent of the driver's own count: the time from
a step of joint1's setpoint until half of it is measured, at the beginning and at the end. It contains the arm's own
lag; the difference between both is the backlog.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import tyro

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.messages import ArmSetpoint

_STEP_RAD = 0.02
_STEPS = 5
_STEP_TIMEOUT_S = 1.0


@dataclass(frozen=True, kw_only=True)
class Config:
    """Measurement."""

    seconds: float = 60.0
    """Duration of the stream [s]."""
    address: str = ""
    """Host, command port and state port of a controller, as HOST:PORT:PORT; empty = start the twin's."""
    mode: Z1Mode = Z1Mode.TRACKING
    """Command mode."""


def main(config: Config) -> None:
    """Print the latencies."""
    with ExitStack() as stack:
        arm = _make_arm(config, stack)
        arm.connect()
        stack.callback(arm.disconnect)
        q = arm.read_state().q.copy()
        first = _measure_steps(arm, q)
        _stream(arm, q, config.seconds)
        last = _measure_steps(arm, q)
        latency, counts = arm.command_latency(), arm.diagnostics().counts
        print(
            f"command latency p50 {latency.p50_ms:.1f}, p99 {latency.p99_ms:.1f}, max {latency.max_ms:.1f} ms; "
            f"{counts.sent} commands sent, {counts.skipped} replaced by a newer one, {counts.answers} answers"
        )
        print(
            f"step latency {1e3 * first:.1f} ms at first, {1e3 * last:.1f} ms after {config.seconds:.0f} s: "
            f"backlog {1e3 * (last - first):.1f} ms"
        )
        print(f"the controller is in {arm.fsm.name}")


def _make_arm(config: Config, stack: ExitStack) -> Z1Arm:
    clock = WallClock()
    if config.address:
        host, command_port, state_port = config.address.split(":")
        address = Z1ArmConfig(host=host, command_port=int(command_port), state_port=int(state_port), mode=config.mode)
        return Z1Arm(clock, address)
    from sim_twin.drop_in.rig import make_wire_sim_rig

    rig = make_wire_sim_rig(mode=config.mode)
    stack.callback(rig.world.close)
    assert isinstance(rig.arm, Z1Arm)
    return rig.arm


def _stream(arm: Z1Arm, q: np.ndarray, duration_s: float) -> None:
    clock = arm.clock
    deadline_s = clock.now_s()
    for _ in range(round(duration_s / z1.CONTROL_PERIOD_S)):
        arm.read_state()
        arm.send(ArmSetpoint(q=q, dq=np.zeros(z1.N_JOINTS)))
        deadline_s = max(deadline_s + z1.CONTROL_PERIOD_S, clock.now_s())
        clock.sleep_until(deadline_s)


def _measure_steps(arm: Z1Arm, q: np.ndarray) -> float:
    """Return the median time [s] from a step of joint1's setpoint until half of it is measured."""
    clock, taken_s = arm.clock, []
    for step in range(_STEPS):
        goal = q.copy()
        goal[0] += _STEP_RAD if step % 2 == 0 else 0.0
        begin, half = arm.read_state().q[0], 0.5 * _STEP_RAD
        start_s = clock.now_s()
        while abs(arm.read_state().q[0] - begin) < half and clock.now_s() < start_s + _STEP_TIMEOUT_S:
            arm.send(ArmSetpoint(q=goal, dq=np.zeros(z1.N_JOINTS)))
            clock.sleep_until(clock.now_s() + z1.CONTROL_PERIOD_S)
        taken_s.append(clock.now_s() - start_s)
        _stream(arm, goal, 0.3)
    return float(np.median(taken_s))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))

"""A servo over a mock arm on a manual clock, and trajectories for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hal.backends.mock_arm import MockArm
from hal.base.clock import ManualClock
from hal.base.messages import ArmSetpoint, ServoMode, TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, N_ARM, N_JOINTS, Q_HOME
from hal.servo.servo import Servo

START = np.append(Q_HOME, -0.5)
STEP = np.array([0.8, 0.4, -0.5, 0.3, 0.3, -0.6, -0.4])


class Bench:
    """A clock, a mock arm and its servo, connected and claimed by "test"."""

    def __init__(self, *, start: np.ndarray = START, **servo_options: Any) -> None:
        self.clock = ManualClock(5.0)
        self.arm = MockArm(self.clock, q=start)
        self.servo = Servo(self.arm, self.clock, **servo_options)
        self.servo.connect()
        self.servo.claim("test")
        self.sent: list[np.ndarray] = [start]

    def run(self, duration_s: float, every_tick: Callable[[], None] = lambda: None) -> None:
        for _ in range(round(duration_s / CONTROL_PERIOD_S)):
            every_tick()
            self.servo.tick()
            self.sent.append(self.servo.status().q_command)
            self.clock.advance(CONTROL_PERIOD_S)

    def run_until_at_rest(self, allowed_s: float = 0.4) -> float:
        """Tick until the arm is at rest; return the duration [s]."""
        for i in range(round(allowed_s / CONTROL_PERIOD_S)):
            self.run(CONTROL_PERIOD_S)
            if self.mode in (ServoMode.HOLDING, ServoMode.STOPPED):
                return (i + 1) * CONTROL_PERIOD_S
        raise AssertionError(f"still {self.mode} after {allowed_s} s")

    @property
    def mode(self) -> ServoMode:
        return self.servo.status().mode

    @property
    def reason(self) -> str:
        return self.servo.status().reason

    def commanded(self) -> np.ndarray:
        """Return all setpoints sent since the start, (N, 7) [rad]."""
        return np.array(self.sent)


def move(
    trajectory_id: int = 1,
    *,
    start: np.ndarray = START,
    step: np.ndarray = STEP,
    duration_s: float = 1.0,
    until_s: float | None = None,
    from_s: float = 0.0,
) -> TrajectoryChunk:
    """Return a quintic from rest to rest, or its section between `from_s` and `until_s` (then not final)."""
    end_s = duration_s if until_s is None else until_s
    t_s = np.linspace(from_s, end_s, round((end_s - from_s) / 0.02) + 1)
    s = t_s / duration_s
    x = 10 * s**3 - 15 * s**4 + 6 * s**5
    v = (30 * s**2 - 60 * s**3 + 30 * s**4) / duration_s
    return TrajectoryChunk(
        trajectory_id=trajectory_id,
        t_s=t_s,
        q=start + x[:, None] * step,
        dq=v[:, None] * step,
        final=until_s is None,
    )


RAMP_S = 0.65
"""Time of `cruise` to its speed, with which full speed stays within acceleration and jerk [s]."""


def cruise(joint: int, speed: float, duration_s: float, start: np.ndarray = START) -> TrajectoryChunk:
    """Return a motion of one joint from rest to `speed`, smoothly, then at that speed until a buffer underrun."""
    t_s = np.arange(0.0, duration_s + 1e-9, 0.01)
    q, dq = np.tile(start, (len(t_s), 1)), np.zeros((len(t_s), N_JOINTS))
    u = np.clip(t_s / RAMP_S, 0, 1)
    dq[:, joint] = speed * (1 - np.cos(np.pi * u)) / 2
    ramped = speed * RAMP_S * (u - np.sin(np.pi * u) / np.pi) / 2
    q[:, joint] += ramped + speed * np.maximum(t_s - RAMP_S, 0.0)
    return TrajectoryChunk(trajectory_id=1, t_s=t_s, q=q, dq=dq)


def setpoint(q: np.ndarray) -> ArmSetpoint:
    return ArmSetpoint(q=q, dq=np.zeros(N_JOINTS))


ARM = slice(0, N_ARM)

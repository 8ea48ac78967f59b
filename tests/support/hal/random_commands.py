"""Random sequences of commands of a client that sends only legal chunks, and the oracle of the setpoints they lead to.

Every chunk is a section of a smooth motion within the limits, and its points are inside the guard's space. What the
client does with them is careless: it sends a section that ends in motion and nothing after it, calls it final, replaces
it by another motion, releases the arm or stops it at any time.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cache

import numpy as np

from hal.base.clock import ManualClock
from hal.base.errors import HalError
from hal.base.messages import ArmSetpoint, ArmState, ServoMode, TrajectoryChunk
from hal.base.z1 import CONTROL_PERIOD_S, DDDQ_MAX, DDQ_MAX, DQ_MAX, N_JOINTS, Q_MAX, Q_MIN
from hal.servo.control_loop import ControlCycle
from hal.servo.guard import Guard
from hal.servo.limits import ServoLimits
from hal.servo.servo import Servo

ROOM_M = 1.2e-3
"""The guard's slack of 1 mm at rest, and what the gripper moves between two postures that it checks [m]."""
TOLERANCE = 1.05
"""Of acceleration and jerk, as of the chunks that the servo accepts."""
_REST_TICKS = 125
_LEADS_S = (0.1, 0.15, 0.3, 0.6, 1.5)
_SPACINGS_S = (0.002, 0.002, 0.005, 0.01)


@cache
def shared_guard() -> Guard:
    return Guard()


@cache
def _postures(n: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Return random postures inside the guard's space and outside it, (N, 7) each [rad]."""
    q = np.random.default_rng(1).uniform(Q_MIN, Q_MAX, (n, N_JOINTS))
    inside = np.min(shared_guard().compute_margins(q), axis=0) > 0.005
    return q[inside], q[~inside]


class ExactArm:
    """An arm that is at its last setpoint at once, and records all of them."""

    def __init__(self, clock: ManualClock, q: np.ndarray) -> None:
        self._clock = clock
        zero = np.zeros(N_JOINTS)
        self.state = ArmState(stamp_s=clock.now_s(), q=q, dq=zero, tau=zero)
        self.sent: list[np.ndarray] = []

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def stop(self) -> None: ...

    def read_state(self) -> ArmState:
        return self.state

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        object.__setattr__(self.state, "q", setpoint.q)  # a new message for each tick would double its duration
        self.sent.append(setpoint.q)
        return setpoint


class UnmeasuredCycle(ControlCycle):
    """A cycle without the checks of the measurement, which follows exactly here."""

    def _measure(self) -> None: ...


class UnmeasuredServo(Servo):
    cycle_type = UnmeasuredCycle


class _Motion:
    """A quintic from rest to rest, as fast as the limits allow; `section` returns a part of it as a chunk."""

    def __init__(self, start: np.ndarray, goal: np.ndarray, speed: float) -> None:
        self._start, self._step = start, goal - start
        d = np.abs(self._step)
        # Peaks of a quintic over its duration T: speed 15/8 d/T, acceleration 5.78 d/T², jerk 60 d/T³.
        times = (1.875 * d / DQ_MAX, np.sqrt(5.78 * d / DDQ_MAX), np.cbrt(60.0 * d / DDDQ_MAX))
        self.duration_s = max(float(np.max(times)) / speed, 0.1)

    def at(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = np.clip(t_s / self.duration_s, 0.0, 1.0)[:, None]
        q = self._start + u**3 * (10 - 15 * u + 6 * u * u) * self._step
        return q, 30 * u * u * (1 - u) ** 2 / self.duration_s * self._step

    def leave_s(self) -> float:
        """Return the time at which the motion leaves the guard's space, its duration if it does not [s]."""
        t_s = np.arange(0.0, self.duration_s, 0.02)
        outside = np.flatnonzero(np.min(shared_guard().compute_margins(self.at(t_s)[0]), axis=0) < 0.0)
        return float(t_s[max(outside[0] - 1, 0)]) if len(outside) else self.duration_s

    def section(self, trajectory_id: int, from_s: float, until_s: float, spacing_s: float, final: bool):
        n = max(round((until_s - from_s) / spacing_s), 1)
        t_s = from_s + np.arange(n + 1) * spacing_s
        if until_s >= self.duration_s:
            t_s = t_s[t_s < self.duration_s - 1e-6]
            t_s = np.append(t_s, self.duration_s) if len(t_s) else np.array([self.duration_s])
        q, dq = self.at(t_s)
        return TrajectoryChunk(trajectory_id=trajectory_id, t_s=t_s, q=q, dq=dq, final=final)


class CarelessClient:
    """A client of one servo over an `ExactArm`, which acts at random."""

    def __init__(self, rng: np.random.Generator) -> None:
        inside, _ = _postures()
        self._rng = rng
        self.start = inside[rng.integers(len(inside))]
        self._clock = ManualClock(5.0)
        self.arm = ExactArm(self._clock, self.start)
        self.servo = UnmeasuredServo(self.arm, self._clock, guard=shared_guard())
        self.servo.connect()
        self.servo.claim("test")
        self.modes: list[ServoMode] = []
        self.accepted = 0
        self.skips = rng.random() < 0.97
        self.stopped = False
        """True when the sequence ends with a stop, after which the arm has to be at rest."""
        self._motion: _Motion | None = None
        self._sent_s, self._leave_s, self._spacing_s = 0.0, 0.0, 0.002

    def run_sequence(self) -> None:
        """Act a few times at random, then wait until the arm is at rest."""
        actions = (self._begin, self._continue, self._release, self._stop, self._send)
        self._begin()
        self._tick(int(self._rng.integers(10, 400)))
        for _ in range(int(self._rng.integers(1, 3))):
            with suppress(HalError):
                actions[self._rng.choice(len(actions), p=(0.45, 0.3, 0.1, 0.1, 0.05))]()
            self._tick(int(self._rng.integers(1, 80)))
        if self._rng.random() < 0.5:
            self._tick(int(self._rng.integers(1, 100)))
            self.servo.stop()
            self.stopped = True
        self._tick(_REST_TICKS, until_rest=True)

    @property
    def is_at_rest(self) -> bool:
        snapshot = self.servo._snapshot
        assert snapshot is not None
        return snapshot.at_rest

    def _tick(self, n: int, *, until_rest: bool = False) -> None:
        left = n
        while left > 0:
            left -= 1
            self.servo.tick()
            self._clock.advance(CONTROL_PERIOD_S)
            snapshot = self.servo._snapshot
            assert snapshot is not None
            self.modes.append(snapshot.mode)
            if until_rest and snapshot.at_rest and self.servo._mailbox.active_trajectory is None:
                self._tick(2)
                return
            left -= self._fast_forward(left - 4) if self.skips else 0

    def _fast_forward(self, n: int) -> int:
        """Advance up to `n` ticks at rest, or through a trajectory that plays, whose setpoints are the points of its
        buffer; return their number. Most of a motion would be spent on ticks that do nothing else."""
        cycle = self.servo._cycle
        motion, path = cycle._motion, self.servo._mailbox.active_trajectory
        if n >= 4 and path is None and self.servo._mailbox.target is None and not motion.is_moving:
            self.arm.sent.extend([motion.q] * n)
            self.modes.extend([motion.mode] * n)
            self._clock.advance(n * CONTROL_PERIOD_S)
            return n
        playing = motion.mode is ServoMode.TRACKING and motion._move is None and motion.trajectory_time_s >= 0.0
        if n < 4 or path is None or not playing or path.trajectory_id != motion.trajectory_id:
            return 0
        begin = round((motion.trajectory_time_s - path.t_s[0]) / CONTROL_PERIOD_S) + 1
        t_s = np.array(path.t_s[begin : begin + n])
        if not path.final:
            t_s = t_s[: int(np.argmin(np.append(t_s + path.stop_s[begin : begin + n] / 2 <= path.end_s - 1e-3, False)))]
        n = min(n, len(t_s) - 2)
        if n < 4:
            return 0
        last = begin + n - 1
        q = path.q[last].copy()
        motion.q, motion._dq, motion._path, motion.trajectory_time_s = q, path.dq[last].copy(), path, path.t_s[last]
        cycle._q_sent = q
        object.__setattr__(self.arm.state, "q", q)
        self.arm.sent.extend(path.q[begin : last + 1])
        self.modes.extend([ServoMode.TRACKING] * n)
        self._clock.advance(n * CONTROL_PERIOD_S)
        self.servo._snapshot = cycle.snapshot(self._clock.now_s())
        return n

    def _begin(self) -> None:
        """Send the beginning of a new motion, half of the time towards a posture outside the guard's space."""
        rng, (inside, outside) = self._rng, _postures()
        pool = outside if rng.random() < 0.5 else inside
        here = self.servo._snapshot.q_sent  # pyright: ignore[reportOptionalMemberAccess]
        start = here + rng.uniform(-0.04, 0.04, N_JOINTS) if rng.random() < 0.15 else here
        start = np.clip(start, Q_MIN, Q_MAX)
        goal = pool[rng.integers(len(pool))]
        if rng.random() < 0.3:  # into a corner of the joints' space
            goal = np.where(rng.random(N_JOINTS) < 0.5, goal, np.where(rng.random(N_JOINTS) < 0.5, Q_MIN, Q_MAX))
        self._motion = _Motion(start, goal, rng.uniform(0.4, 1.0))
        self._leave_s = self._motion.leave_s()
        self._spacing_s = float(rng.choice(_SPACINGS_S))
        self._sent_s, self._id = 0.0, self.servo.status().trajectory_id + 1
        with suppress(HalError):
            self._stream(float(rng.choice(_LEADS_S)))

    def _continue(self) -> None:
        if self._motion is not None:
            self._stream(float(self._rng.choice(_LEADS_S)))

    def _stream(self, lead_s: float) -> None:
        motion = self._motion
        assert motion is not None
        until_s = min(self._sent_s + lead_s, self._leave_s)
        final = until_s >= motion.duration_s or self._rng.random() < 0.2
        chunk = motion.section(self._id, self._sent_s, until_s, self._spacing_s, final)
        self.servo.stream(chunk)
        self.accepted += 1
        self._sent_s = float(chunk.t_s[-1])

    def _release(self) -> None:
        self.servo.release()
        self.servo.claim("test")

    def _stop(self) -> None:
        self.servo.stop()
        self._tick(int(self._rng.integers(1, 150)))
        self.servo.rearm()
        self.servo.claim("test")

    def _send(self) -> None:
        inside, _ = _postures()
        goal = inside[self._rng.integers(len(inside))]
        for _ in range(int(self._rng.integers(1, 4))):
            self.servo.send(ArmSetpoint(q=goal, dq=np.zeros(N_JOINTS)))
            self._tick(int(self._rng.integers(1, 40)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Violations:
    """Numbers of setpoints that break a rule; all but the first two are 0 for a safe servo."""

    setpoints: int = 0
    accepted: int = 0
    """Chunks that the servo accepted."""
    outside_guard: int = 0
    outside_joint_limits: int = 0
    too_fast: int = 0
    beyond_acceleration: int = 0
    beyond_jerk: int = 0
    still_moving: int = 0
    """Sequences after which the arm is reported at rest and is not, or is not at rest after a stop."""

    def __add__(self, other: Violations) -> Violations:
        return Violations(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    @property
    def total(self) -> int:
        return sum(getattr(self, f.name) for f in fields(self)) - self.setpoints - self.accepted


def check_setpoints(client: CarelessClient, limits: ServoLimits | None = None) -> Violations:
    """Return the violations among all setpoints that `client` made its servo send."""
    limits = limits or ServoLimits()
    q = np.vstack([*[client.start] * 3, *client.arm.sent])
    braking = np.array([False] * 3 + [mode in (ServoMode.BRAKING, ServoMode.STOPPED) for mode in client.modes])
    # A stop has limits of its own; a difference over several ticks belongs to it when one of them does.
    near = braking[3:] | braking[2:-1] | braking[1:-2] | braking[:-3]
    # The tick in which a stop ends is no longer BRAKING.
    ddq_max = np.where(near[:, None], getattr(limits, "brake_ddq_max", limits.ddq_max), limits.ddq_max)
    dddq_max = np.where(near[:, None], getattr(limits, "brake_dddq_max", limits.dddq_max), limits.dddq_max)
    dq = np.diff(q, axis=0) / CONTROL_PERIOD_S
    ddq = np.diff(dq, axis=0) / CONTROL_PERIOD_S
    dddq = np.diff(ddq, axis=0) / CONTROL_PERIOD_S
    margins = shared_guard().compute_margins(q[3:])
    return Violations(
        setpoints=len(q) - 3,
        accepted=client.accepted,
        outside_guard=int((np.min(margins, axis=0) < -ROOM_M).sum()),
        outside_joint_limits=int(((q < Q_MIN - 1e-9) | (q > Q_MAX + 1e-9)).any(axis=1).sum()),
        too_fast=int((np.abs(dq) > 1.0011 * limits.dq_max).any(axis=1).sum()),
        beyond_acceleration=int((np.abs(ddq[1:]) > TOLERANCE * ddq_max).any(axis=1).sum()),
        beyond_jerk=int((np.abs(dddq) > TOLERANCE * dddq_max).any(axis=1).sum()),
        still_moving=int(
            (client.is_at_rest and bool((np.abs(dq[-1]) > 1e-6).any())) or client.stopped > client.is_at_rest
        ),
    )


def run_sequences(seeds: range) -> tuple[Violations, int | None]:
    """Run one sequence for each seed; return all violations and the first seed that has one."""
    total, first = Violations(), None
    for seed in seeds:
        client = CarelessClient(np.random.default_rng(seed))
        client.run_sequence()
        found = check_setpoints(client)
        total += found
        if found.total and first is None:
            first = seed
    return total, first

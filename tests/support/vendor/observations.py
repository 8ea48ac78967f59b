"""Observations of a controller: labels, packets, backlog, silence, limits, motions and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.z1_kinematics import PivotKinematics, posture_from_pose
from hal.z1_protocol.controller import KD_LOWCMD, KP_LOWCMD, LABELS, TrajectoryCommand, encode_command
from hal.z1_protocol.records import JointCommands, MotorError
from hal.z1_protocol.states import Fsm
from tests.support.vendor.probe import PERIOD_S, Probe, move_from

_REQUESTS = 5
_REACHED_RAD = 0.05
_JOINT1 = np.eye(z1.N_JOINTS)[0]


@dataclass(frozen=True, slots=True)
class Observation:
    """One value of a controller."""

    name: str
    value: str | float
    tolerance: float = 0.1
    """Ratio by which a number may differ and still be the same."""

    def equals(self, other: Observation) -> bool:
        """Return whether both are the same."""
        if isinstance(self.value, str) or isinstance(other.value, str):
            return self.value == other.value
        return abs(self.value - other.value) <= self.tolerance * max(abs(self.value), abs(other.value)) + 1e-3


Observer = Callable[[Probe], Iterator[Observation]]


def observe_labels(probe: Probe) -> Iterator[Observation]:
    """Labels and lessons, known and unknown."""
    probe.go(Fsm.JOINTCTRL)
    saved = probe.newest.joints.q
    for name, state, body in (
        ("unknown label", Fsm.TOSTATE, "nowhere"),
        ("unknown lesson", Fsm.TEACHREPEAT, "nowhere"),
        ("saved label with a space", Fsm.SAVESTATE, "my pose"),
        ("pose out of reach", Fsm.MOVEJ, move_from(probe.newest.pose, (0, 0, 0, 2.0, 0, 0), speed=1.0)),
    ):
        seen = probe.ask(state, body, hold_s=0.1)
        yield Observation(name, " ".join(seen[seen.index(state.name) :] if state.name in seen else seen))
    probe.move(Fsm.TOSTATE, "show_mid")
    yield Observation("show_mid: joint4", float(probe.newest.joints.q[3]))
    probe.move(Fsm.TOSTATE, "my pose")
    probe.hold(0.3)
    moved = np.abs(probe.newest.joints.q - saved)[: z1.N_ARM].max()
    yield Observation("the saved label is reached", str(bool(moved < _REACHED_RAD)))


def observe_packets(probe: Probe) -> Iterator[Observation]:
    """Sizes, heads and flags of packets."""
    probe.go(Fsm.JOINTCTRL)
    for name, change in (
        ("147 B", lambda data: data),
        ("148 B", lambda data: data + b"x"),
        ("146 B", lambda data: data[:146]),
        ("another head", lambda data: b"\0\0" + data[2:]),
        ("state 99", lambda data: data[:2] + b"\x63\0\0\0" + data[6:]),
    ):
        probe.go(Fsm.JOINTCTRL)
        data = encode_command(Fsm.CARTESIAN, JointCommands(q=probe.newest.joints.q))
        probe.hold(0.05, change(data))
        yield Observation(f"request of {name}", probe.fsm.name)
    probe.go(Fsm.JOINTCTRL)
    command = bytearray(probe.track(probe.newest.joints.q + 0.3 * _JOINT1))
    command[6] = 2
    probe.hold(0.5, bytes(command))
    yield Observation("track flag 2: joint1 moves", str(bool(probe.newest.joints.q[0] > 0.2)))
    probe.hold(0.5, probe.track(probe.newest.joints.q * (1.0 - _JOINT1)))


def observe_backlog(probe: Probe) -> Iterator[Observation]:
    """Datagrams that arrive faster than they are read."""
    probe.go(Fsm.JOINTCTRL)
    keep = encode_command(Fsm.INVALID, JointCommands(q=probe.newest.joints.q))
    for count in (50, 150):
        probe.go(Fsm.JOINTCTRL)
        start_s = probe.line.now_s()
        for _ in range(count):
            probe.line.send(keep)
        # One alone may be overwritten by the next before the state machine sees it
        for _ in range(_REQUESTS):
            probe.line.send(encode_command(Fsm.CARTESIAN, JointCommands(q=probe.newest.joints.q)))
        while probe.fsm is not Fsm.CARTESIAN and probe.line.now_s() < start_s + 2.0:
            probe.hold(PERIOD_S, keep)
        yield Observation(f"request behind {count} datagrams [s]", probe.line.now_s() - start_s, 0.2)
    probe.go(Fsm.JOINTCTRL)
    for _ in range(1000):
        probe.line.send(keep)
    probe.line.send(encode_command(Fsm.CARTESIAN, JointCommands(q=probe.newest.joints.q)))
    probe.line.run(2.0)
    yield Observation("request behind 1000 datagrams", probe.fsm.name)


def observe_silence(probe: Probe) -> Iterator[Observation]:
    """A client that falls silent."""
    for state in (Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.LOWCMD, Fsm.TEACH):
        probe.go(Fsm.PASSIVE)
        if state is not Fsm.LOWCMD:
            probe.go(Fsm.JOINTCTRL)
        if state is not Fsm.JOINTCTRL:
            probe.ask(state, "silent" if state is Fsm.TEACH else None)
        since, start_s = len(probe.line.answers), probe.line.now_s()
        while probe.fsm is not Fsm.PASSIVE and probe.line.now_s() < start_s + 4.0:
            probe.line.run(0.01)
        elapsed_s = probe.line.now_s() - start_s
        yield Observation(f"{state.name} after silence", probe.fsm.name)
        yield Observation(f"{state.name}: silence until then [s]", elapsed_s)
        yield Observation(f"{state.name}: answers meanwhile [1/s]", (len(probe.line.answers) - since) / elapsed_s)


def observe_low_level(probe: Probe) -> Iterator[Observation]:
    """LOWCMD: limits, and the way out of it."""
    probe.go(Fsm.PASSIVE)
    q = probe.newest.joints.q
    probe.ask(Fsm.LOWCMD, JointCommands(q=q, kp=KP_LOWCMD, kd=KD_LOWCMD))
    far = JointCommands(q=q + 9.0, dq=np.full(7, 50.0), tau=700.0 * _JOINT1)
    probe.line.commanded.clear()
    probe.hold(0.02, encode_command(Fsm.INVALID, far))
    last = probe.line.commanded[-1]
    for name, value in (("position", last.q[0]), ("speed", last.dq[0]), ("torque", last.tau[0])):
        yield Observation(f"LOWCMD: {name} of 9 rad, 50 rad/s, 700 Nm", float(value), 1e-3)
    probe.hold(0.2, encode_command(Fsm.INVALID, JointCommands(q=q + 0.1, kp=KP_LOWCMD, kd=KD_LOWCMD)))
    probe.line.commanded.clear()
    probe.hold(0.03, encode_command(Fsm.JOINTCTRL))
    obeyed = [c for c in probe.line.commanded if not c.kp.any() and not c.q.any()]
    yield Observation("LOWCMD: request without a body is obeyed for a cycle", str(bool(1 <= len(obeyed) <= 2)))
    yield Observation("LOWCMD: reference of joint1 after it [rad]", float(probe.line.commanded[-1].q[0]))
    yield Observation("LOWCMD: state after it", probe.fsm.name)


def observe_tracking(probe: Probe) -> Iterator[Observation]:
    """JOINTCTRL: speed, limits and gains."""
    probe.go(Fsm.JOINTCTRL)
    yield Observation("JOINTCTRL: gain of joint4", float(probe.line.commanded[-1].kp[3]))
    yield Observation("JOINTCTRL: joints with a torque", _with_torque(probe))
    start = probe.newest.joints.q * (1.0 - _JOINT1)
    probe.hold(0.5, probe.track(start))
    probe.line.commanded.clear()
    probe.hold(0.15, probe.track(start + _JOINT1))
    steps = np.diff([c.q[0] for c in probe.line.commanded])
    yield Observation("JOINTCTRL: step of joint1 [rad]", float(np.max(steps)), 0.01)
    probe.hold(0.1, probe.track(start, np.full(7, 50.0) * _JOINT1))
    yield Observation("JOINTCTRL: speed of 50 rad/s", float(probe.line.commanded[-1].dq[0]))
    for target in (-3.0, 1.0):
        probe.hold(0.8, probe.track(np.append(start[:6], target)))
        yield Observation(f"JOINTCTRL: gripper to {target:g} [rad]", float(probe.line.commanded[-1].q[6]), 1e-3)
    probe.line.commanded.clear()
    probe.hold(1.2, probe.track(start + 5.0 * _JOINT1))
    jump = float(np.max(np.diff([c.q[0] for c in probe.line.commanded])))
    yield Observation("JOINTCTRL: joint1 to 5 rad, largest step [rad]", jump, 0.02)
    probe.hold(2.0, probe.track(start))


def observe_twists(probe: Probe) -> Iterator[Observation]:
    """CARTESIAN: the body is a twist."""
    for name, twist, axis in (("ω_x 0.2", [0.2, 0, 0, 0, 0, 0], 0), ("v_y 0.1", [0, 0, 0, 0, 0.1, 0], 4)):
        probe.go(Fsm.JOINTCTRL)
        probe.move(Fsm.TOSTATE, "forward")
        probe.go(Fsm.CARTESIAN)
        before = probe.newest.pose[axis]
        poses = np.array([twist, np.zeros(6)])
        probe.hold(1.0, encode_command(Fsm.INVALID, TrajectoryCommand(poses=poses), track=True))
        yield Observation(f"CARTESIAN: {name} for 1 s", float(probe.newest.pose[axis] - before))
    yield Observation("CARTESIAN: gain of joint4", float(probe.line.commanded[-1].kp[3]))


def observe_motions(probe: Probe) -> Iterator[Observation]:
    """Durations of the controller's own motions, relative to the reference at `forward`, not to where the arm sags."""
    probe.go(Fsm.JOINTCTRL)
    probe.move(Fsm.BACKTOSTART)
    yield Observation("TOSTATE forward from startFlat [s]", probe.move(Fsm.TOSTATE, "forward"))
    here = posture_from_pose(PivotKinematics().forward(LABELS["forward"]))
    up, half = (0, 0, 0, -0.1, 0.15, 0.1), ((0, 0, 0, 0, 0.05, 0.05), (0, 0, 0, 0, 0, 0.1))
    moves = [
        *((Fsm.MOVEJ, speed, (up,)) for speed in (0.5, 1.0, 2.0, 0.0)),
        *((Fsm.MOVEL, speed, (up,)) for speed in (0.1, 0.3, 1.0, 0.0)),
        *((Fsm.MOVEC, speed, half) for speed in (0.1, 0.5, 0.0)),
    ]
    for state, speed, steps in moves:
        duration_s = probe.move(state, move_from(here, *steps, speed=speed))
        # MOVEC starts from the measured pose, and half a circle is where the complement of its arc changes the most
        tolerance = 0.2 if state is Fsm.MOVEC else 0.1
        yield Observation(f"{state.name} at {speed:g} [s]", duration_s, tolerance)
        probe.move(Fsm.TOSTATE, "forward")
    line = move_from(here, (0, 0, 0, 0, 0.02, 0), (0, 0, 0, 0, 0.04, 0), speed=0.3)
    probe.ask(Fsm.MOVEC, line, hold_s=3.0)
    yield Observation("MOVEC along a line, after 3 s", probe.fsm.name)
    yield Observation("BACKTOSTART from there: gripper [rad]", _gripper_after_homing(probe))


def observe_faults(probe: Probe) -> Iterator[Observation]:
    """Motors with errors, a silent board, a calibration; none of it with real motors."""
    motors = probe.line.motors
    if motors is None:
        return
    for bit in (MotorError.OVER_CURRENT, MotorError.LEAKAGE, MotorError.OVERHEAT, MotorError.PARAMETER_JUMP):
        probe.go(Fsm.JOINTCTRL)
        motors.error[2, 0] = bit
        probe.hold(0.1)
        motors.error[2, 0] = 0
        yield Observation(f"JOINTCTRL with {bit.name}", probe.fsm.name)
        probe.hold(0.1)
    for silent_s in (1.5, 3.0):
        probe.go(Fsm.JOINTCTRL)
        motors.silent = True
        probe.hold(silent_s)
        motors.silent = False
        yield Observation(f"JOINTCTRL with a board silent for {silent_s:g} s", probe.fsm.name)
        probe.hold(0.5)
    probe.go(Fsm.PASSIVE)
    before = np.abs(probe.newest.joints.q[: z1.N_ARM]).max()
    probe.ask(Fsm.CALIBRATION, hold_s=0.5)
    yield Observation("CALIBRATION, half a second after its request", probe.fsm.name)
    probe.hold(2.5)
    after = np.abs(probe.newest.joints.q[: z1.N_ARM]).max()
    yield Observation("CALIBRATION: the joints read zero afterwards", str(bool(after < 0.1 * before)))
    yield Observation("CALIBRATION, when it has ended", probe.fsm.name)


SHORT: tuple[Observer, ...] = (observe_labels, observe_packets, observe_backlog, observe_low_level, observe_tracking)
"""Observers that are short enough for every run."""
LONG: tuple[Observer, ...] = (observe_silence, observe_twists, observe_motions, observe_faults)
"""The others."""


def _with_torque(probe: Probe) -> str:
    torque = np.abs(probe.line.commanded[-1].tau) > 1e-3
    return " ".join(z1.JOINT_NAMES[i] for i in np.flatnonzero(torque) if i > 0)


def _gripper_after_homing(probe: Probe) -> float:
    probe.ask(Fsm.BACKTOSTART)
    probe.wait_for(Fsm.JOINTCTRL)
    return float(probe.line.commanded[-1].q[6])

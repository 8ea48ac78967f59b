"""Fake of the vendor's controller and its arm: its wire protocol and state transitions, with fault injection.

Its physics are damped joints under gravity. The twin has the rest.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from threading import Event, Thread
from typing import Protocol

import numpy as np

from hal.backends.z1.torque_limits import motor_torques
from hal.base import z1
from hal.base.clock import Clock
from hal.base.z1_dynamics import FeedForward
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture, posture_from_pose
from hal.z1_protocol.controller import (
    KD_PASSIVE,
    LABELS,
    Command,
    ControllerState,
    decode_command,
    encode_state,
)
from hal.z1_protocol.records import KD_SCALE, KP_SCALE, JointCommands, JointStates, ProtocolError
from hal.z1_protocol.states import MOVES, Fsm, is_granted

_INERTIA = 0.2
_VISCOUS = 0.5
_LAG_S = 0.005
_NONE = JointCommands()


@cache
def gravity_model() -> FeedForward:
    return FeedForward()


@cache
def pivot_kinematics() -> PivotKinematics:
    return PivotKinematics()


class FakeController:
    """States, transitions and motion of the controller, driven by `handle` alone."""

    def __init__(self, clock: Clock, q: np.ndarray | None = None) -> None:
        self.clock = clock
        self.fsm = Fsm.PASSIVE
        self.q = np.append(z1.Q_HOME, -0.5) if q is None else np.array(q, dtype=float)
        self.dq = np.zeros(z1.N_JOINTS)
        self.tau = np.zeros(z1.N_JOINTS)
        self.target = self.q.copy()
        self.commands = _NONE
        self.tracking = False
        self._goal: np.ndarray | None = None
        self._moved_s = clock.now_s()
        self._frozen: bytes | None = None
        self._reported = JointStates(q=self.q)
        self.error = np.zeros((z1.N_JOINTS, 2), dtype=np.uint8)
        """(7, 2) error bits of the motors."""
        self.link = np.zeros((z1.N_JOINTS, 2), dtype=np.uint8)
        """(7, 2) link states of the motors."""
        self.temperature_c = np.full((z1.N_JOINTS, 2), 30, dtype=np.int8)
        """(7, 2) temperatures of the motors [°C]."""
        self.ignored_requests: set[Fsm] = set()
        """States whose requests it ignores."""
        self.mute = False
        """It does not answer while this is set."""
        self.stuck: int | None = None
        """A blocked joint."""
        self.rests = False
        """The arm is supported in PASSIVE."""
        self.load = np.zeros(z1.N_JOINTS)
        """(7,) load on the joints in addition to gravity [Nm]."""
        self.noise_rad = 0.0
        """Standard deviation of the measured positions."""
        self._rng = np.random.default_rng(0)
        self.received: list[Command] = []
        """Every valid command."""
        self.invalid_datagrams = 0
        """Datagrams that could not be decoded."""
        self.highest_torque = np.zeros(z1.N_JOINTS)
        """(7,) maximum torque of a command in LOWCMD at the last reported state [Nm]."""

    def handle(self, data: bytes) -> bytes | None:
        """Process a datagram; return the answer."""
        self.move()
        try:
            command = decode_command(data)
            self._execute(command)
        except ProtocolError:
            self.invalid_datagrams += 1
            return None
        self.received.append(command)
        return None if self.mute else self.answer()

    def answer(self) -> bytes:
        """Return the answer, with the last measurement repeated while its board is silent."""
        if self._frozen is not None:
            return self._frozen
        joints = JointStates(
            q=self.q + self._rng.normal(0.0, self.noise_rad, z1.N_JOINTS),
            dq=self.dq,
            tau=self.tau,
            temperature_c=self.temperature_c,
            error=self.error,
            link=self.link,
        )
        self._reported = joints
        return encode_state(ControllerState(state=self.fsm, joints=joints, pose=self.pose()))

    def pose(self) -> np.ndarray:
        """Return roll, pitch, yaw, x, y, z (6,) of the pivot."""
        return posture_from_pose(pivot_kinematics().forward(self.q[:6]))

    def silence_board(self, silent: bool) -> None:
        """Silence the motor board, or let it answer again."""
        self._frozen = self.answer() if silent else None

    def _execute(self, command: Command) -> None:
        if command.state not in (Fsm.INVALID, self.fsm):
            if not is_granted(self.fsm, command.state) or command.state in self.ignored_requests:
                return
            if command.state in MOVES and not self._set_goal(command):
                return
            self.fsm, self.target = command.state, self.q.copy()
        self.tracking = command.track and self.fsm is Fsm.JOINTCTRL
        if self.tracking:
            self.target = command.joints().q
        elif self.fsm is Fsm.LOWCMD:
            self.commands = command.joints()
            torque = np.abs(motor_torques(self.commands, self._reported))
            self.highest_torque = np.maximum(self.highest_torque, torque)

    def _set_goal(self, command: Command) -> bool:
        """Set the goal of a controller motion, always a line in joint space; return whether it is reachable."""
        if command.state in (Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC):
            move = command.trajectory()
            pose = pose_from_posture(move.poses[1 if command.state is Fsm.MOVEC else 0])
            q = pivot_kinematics().inverse(pose, self.q[:6])
            if q is None:
                return False
            self._goal = np.append(q, move.gripper_rad)
            return True
        label = command.label() if command.state is Fsm.TOSTATE else "startFlat"
        if label not in LABELS:
            return False
        self._goal = np.append(LABELS[label], self.q[6])
        return True

    def move(self) -> None:
        """Advance to the present time."""
        now_s = self.clock.now_s()
        while self._moved_s < now_s - 1e-9:
            dt_s = min(0.002, now_s - self._moved_s)
            self._step(dt_s)
            self._moved_s += dt_s

    def _step(self, dt_s: float) -> None:
        before = self.q.copy()
        gravity = gravity_model().torque(self.q, np.zeros(z1.N_JOINTS)) + self.load
        if self.fsm is Fsm.PASSIVE and self.rests:
            self.tau = np.zeros(z1.N_JOINTS)
        elif self.fsm in (Fsm.PASSIVE, Fsm.LOWCMD):
            self._push(gravity, dt_s)
        else:
            self._follow(dt_s)
            self.tau = gravity
        if self.stuck is not None:
            self.q[self.stuck] = before[self.stuck]
        self.dq = (self.q - before) / dt_s

    def _push(self, gravity: np.ndarray, dt_s: float) -> None:
        c = self.commands if self.fsm is Fsm.LOWCMD else JointCommands(kd=KD_PASSIVE)
        kp, kd = KP_SCALE * c.kp, KD_SCALE * c.kd
        self.tau = np.clip(c.tau + kp * (c.q - self.q) + kd * (c.dq - self.dq), -z1.TAU_MAX, z1.TAU_MAX)
        # The damping is implicit: it is stiffer than the step is short.
        damping = (kd + _VISCOUS) * (np.abs(self.tau) < z1.TAU_MAX) + _VISCOUS * (np.abs(self.tau) >= z1.TAU_MAX)
        drive = self.tau + damping * self.dq - _VISCOUS * self.dq - gravity
        self.dq = (_INERTIA * self.dq + dt_s * drive) / (_INERTIA + dt_s * damping)
        self.q = self.q + dt_s * self.dq

    def _follow(self, dt_s: float) -> None:
        if self._goal is not None and self.fsm in MOVES:
            self.target = self._goal
        reach = np.pi * dt_s
        step = (self.target - self.q) * -np.expm1(-dt_s / _LAG_S)
        self.q = self.q + np.clip(step, -reach, reach)
        if self.fsm in MOVES and np.abs(self.q - self.target).max() < 1e-3:
            self.fsm, self._goal = Fsm.JOINTCTRL, None


class Peer(Protocol):
    """Peer that answers datagrams."""

    def handle(self, data: bytes) -> bytes | None: ...


class MemoryLink:
    """Datagram link to a controller within one process and one clock; `mangle` may alter every datagram."""

    def __init__(self, peer: Peer, clock: Clock, latency_s: float = 0.001, name: str = "the fake controller") -> None:
        self.name = name
        self.peer = peer
        self.clock = clock
        self.latency_s = latency_s
        self.mangle: Callable[[bytes], list[bytes]] = lambda data: [data]
        self.is_open = False
        self._waiting: deque[tuple[float, bytes]] = deque()

    def open(self) -> None:
        self.is_open = True
        self._waiting.clear()

    def close(self) -> None:
        self.is_open = False

    def send(self, data: bytes | bytearray) -> bool:
        assert self.is_open
        for command in self.mangle(bytes(data)):
            answer = self.peer.handle(command)
            if answer is not None:
                self._waiting.extend((self.clock.now_s() + self.latency_s, one) for one in self.mangle(answer))
        return True

    def receive(self, timeout_s: float = 0.0) -> memoryview | None:
        end_s = self.clock.now_s() + timeout_s
        if timeout_s and not (self._waiting and self._waiting[0][0] <= self.clock.now_s()):
            self.clock.sleep_until(min(self._waiting[0][0], end_s) if self._waiting else end_s)
        if self._waiting and self._waiting[0][0] <= self.clock.now_s():
            return memoryview(self._waiting.popleft()[1])
        return None

    def describe(self) -> str:
        return self.name

    def fileno(self) -> int | None:
        return None


@contextmanager
def serving(peer: FakeController) -> Iterator[tuple[int, int]]:
    """Serve `peer` on UDP; yields its port and the one that it answers to."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inlet, socket.socket(type=socket.SOCK_DGRAM) as probe:
        inlet.bind(("127.0.0.1", 0))
        inlet.settimeout(0.05)
        probe.bind(("127.0.0.1", 0))
        state_port = probe.getsockname()[1]
        probe.close()
        ended = Event()

        def run() -> None:
            while not ended.is_set():
                try:
                    answer = peer.handle(inlet.recv(65536))
                    if answer is not None:
                        inlet.sendto(answer, ("127.0.0.1", state_port))
                except OSError:  # no datagram, or no client
                    continue

        thread = Thread(target=run, daemon=True)
        thread.start()
        try:
            yield inlet.getsockname()[1], state_port
        finally:
            ended.set()
            thread.join()


def mangle_at_random(rng: np.random.Generator, ratio: float) -> Callable[[bytes], list[bytes]]:
    """Return a `MemoryLink.mangle` that makes a `ratio` of the datagrams lost, doubled, late, cut, too long, changed or
    random."""
    late: list[bytes] = []

    def mangle(data: bytes) -> list[bytes]:
        passed = [*late]
        late.clear()
        if rng.random() >= ratio:
            return [*passed, data]
        changed = bytearray(data)
        changed[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        noise = rng.bytes(int(rng.integers(0, 300)))
        fates = ([], [data, data], None, [data[: rng.integers(len(data))]], [data + noise], [bytes(changed)], [noise])
        fate = fates[rng.integers(len(fates))]
        if fate is None:
            late.append(data)
        return passed + (fate or [])

    return mangle

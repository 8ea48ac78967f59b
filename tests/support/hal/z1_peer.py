"""A stand-in for the vendor's controller and its arm: speaks the wire, keeps its rules, and breaks on request.

It has no more physics than a test needs: damped joints under gravity. The twin has the rest.
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

from hal.backends.z1.torque import FeedForward, motor_torques
from hal.base import z1
from hal.base.clock import Clock
from hal.compat.unitree_arm_interface.model import Z1Model, homoToPosture, postureToHomo
from hal.z1_protocol.controller import (
    KD_PASSIVE,
    LABELS,
    Command,
    ControllerState,
    decode_command,
    encode_state,
)
from hal.z1_protocol.records import KD_SCALE, KP_SCALE, JointCommands, JointStates, ProtocolError
from hal.z1_protocol.states import MOVES, Fsm, granted

_INERTIA = 0.2
_VISCOUS = 0.5
_LAG_S = 0.005
_NONE = JointCommands()


@cache
def gravity_model() -> FeedForward:
    return FeedForward()


@cache
def gripper_model() -> Z1Model:
    return Z1Model.with_gripper()


class FakeController:
    """States, transitions and motion of the controller; `handle` is its whole contact with the world."""

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
        self._told = JointStates(q=self.q)
        self.error = np.zeros((z1.N_JOINTS, 2), dtype=np.uint8)
        """(7, 2) error bits of the motors."""
        self.link = np.zeros((z1.N_JOINTS, 2), dtype=np.uint8)
        """(7, 2) link states of the motors."""
        self.temperature_c = np.full((z1.N_JOINTS, 2), 30, dtype=np.int8)
        """(7, 2) temperatures of the motors [°C]."""
        self.refuses: set[Fsm] = set()
        """States it does not go to, whatever its rules say."""
        self.mute = False
        """It gives no answers while this is set."""
        self.stuck: int | None = None
        """A joint that does not move, whatever is commanded."""
        self.rests = False
        """It lies on something that carries it in PASSIVE."""
        self.load = np.zeros(z1.N_JOINTS)
        """(7,) what pulls at the joints beside gravity [Nm]."""
        self.noise_rad = 0.0
        """Of the measured positions."""
        self._rng = np.random.default_rng(0)
        self.received: list[Command] = []
        """Every command that could be read."""
        self.refused = 0
        """Datagrams that could not."""
        self.highest_torque = np.zeros(z1.N_JOINTS)
        """(7,) the most that a command in LOWCMD meant at the last state that was told [Nm]."""

    def handle(self, data: bytes) -> bytes | None:
        """Take a datagram; return the answer."""
        self.move()
        try:
            command = decode_command(data)
            self._obey(command)
        except ProtocolError:
            self.refused += 1
            return None
        self.received.append(command)
        return None if self.mute else self.answer()

    def answer(self) -> bytes:
        """Return what it tells, the last measurement again while its board is silent."""
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
        self._told = joints
        return encode_state(ControllerState(state=self.fsm, joints=joints, pose=self.pose()))

    def pose(self) -> np.ndarray:
        """Return roll, pitch, yaw, x, y, z (6,) of the pivot."""
        return homoToPosture(gripper_model().forwardKinematics(self.q[:6]))

    def silence_board(self, silent: bool) -> None:
        """Let the arm board say nothing, or speak again."""
        self._frozen = self.answer() if silent else None

    def _obey(self, command: Command) -> None:
        if command.state not in (Fsm.INVALID, self.fsm):
            if not granted(self.fsm, command.state) or command.state in self.refuses:
                return
            if command.state in MOVES and not self._set_goal(command):
                return
            self.fsm, self.target = command.state, self.q.copy()
        self.tracking = command.track and self.fsm is Fsm.JOINTCTRL
        if self.tracking:
            self.target = command.joints().q
        elif self.fsm is Fsm.LOWCMD:
            self.commands = command.joints()
            asked = np.abs(motor_torques(self.commands, self._told))
            self.highest_torque = np.maximum(self.highest_torque, asked)

    def _set_goal(self, command: Command) -> bool:
        """Where the controller's own motion ends; the way there is a line in joint space, whatever was asked."""
        self._goal = self.q.copy()
        if command.state in (Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC):
            move = command.trajectory()
            pose = postureToHomo(move.poses[1 if command.state is Fsm.MOVEC else 0])
            reachable, self._goal[:6] = gripper_model().inverseKinematics(pose, self.q[:6], True)
            self._goal[6] = move.gripper_rad
            return reachable
        label = command.label() if command.state is Fsm.TOSTATE else "startFlat"
        if label in LABELS:
            self._goal[:6] = LABELS[label]
        return label in LABELS

    def move(self) -> None:
        """Move on to the present."""
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
    """Who answers datagrams."""

    def handle(self, data: bytes) -> bytes | None: ...


class MemoryLink:
    """The way to a controller within one process and one clock; `mangle` may do anything to what passes."""

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
                except OSError:  # nothing came, or the client is gone
                    continue

        thread = Thread(target=run, daemon=True)
        thread.start()
        try:
            yield inlet.getsockname()[1], state_port
        finally:
            ended.set()
            thread.join()


def mangled(rng: np.random.Generator, share: float) -> Callable[[bytes], list[bytes]]:
    """Return a `MemoryLink.mangle` under which `share` of the datagrams is lost, doubled, late, cut, too long, changed
    or replaced by noise."""
    late: list[bytes] = []

    def mangle(data: bytes) -> list[bytes]:
        passed = [*late]
        late.clear()
        if rng.random() >= share:
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

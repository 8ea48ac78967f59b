"""Protocol of client ↔ z1_ctrl: commands of 147 B to port 8071, states of 208 B back to port 8072.

The meaning of the last 140 bytes of a command depends on the requested state or, while tracking, on the present one;
`Command.joints`, `.trajectory` and `.label` decode them once it is known.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np

from hal.base import z1
from hal.z1_protocol.records import (
    JOINT_CMD,
    JOINT_STATE,
    KD_SCALE,
    KP_SCALE,
    JointCommands,
    JointStates,
    ProtocolError,
    pack_commands,
    pack_states,
    unpack_commands,
    unpack_states,
)
from hal.z1_protocol.states import Fsm

COMMAND_PORT = 8071
"""Bound by the controller."""
STATE_PORT = 8072
"""Bound by the client; a second arm has another pair."""
WATCHDOG_S = 2.2
"""Silence of the client [s] after which the controller falls to PASSIVE, and the arm sinks (measured)."""
COMMAND_SIZE = 147
STATE_SIZE = 208

# Source of the defaults in LOWCMD: LowlevelCmd.h of the vendor's SDK.
KP_LOWCMD = np.array([20.0, 30.0, 30.0, 20.0, 15.0, 10.0, 20.0])
"""(7,) the client's default gains in LOWCMD, in wire units."""
KD_LOWCMD = np.full(z1.N_JOINTS, 2000.0)
"""(7,) the client's default damping gains in LOWCMD, in wire units."""
KP_JOINTCTRL = z1.KP / KP_SCALE
"""(7,) the controller's gains in JOINTCTRL, in wire units."""
KD_JOINTCTRL = z1.KD / KD_SCALE
"""(7,) the controller's damping gains in JOINTCTRL, in wire units."""
# Measured at the motor board's end of the vendor's controller, which leaves the gripper undamped.
KD_PASSIVE = np.array([10.0, 100.0, 300.0, 10.0, 10.0, 10.0, 0.0])
"""(7,) the controller's damping gains in PASSIVE, where the gains are 0; in wire units."""
LABELS = {
    "forward": np.array([0.0, 1.5, -1.0, -0.54, 0.0, 0.0]),
    "startFlat": np.array([0.0, 0.0, -0.005, -0.074, 0.0, 0.0]),
    "show_left": np.array([-1.0, 0.9, -1.0, -0.3, 0.0, 0.0]),
    "show_mid": np.array([0.0, 0.9, -1.2, 0.25, 0.0, 0.0]),
    "show_right": np.array([1.0, 0.9, -1.0, -0.3, 0.0, 0.0]),
}
"""Labels (6,) that the controller has from the start [rad]."""
for _constant in (KP_LOWCMD, KD_LOWCMD, KP_JOINTCTRL, KD_JOINTCTRL, KD_PASSIVE, *LABELS.values()):
    _constant.setflags(write=False)

# Layouts as measured on the vendor's controller; all are packed and little-endian.
_HEAD = b"\xfe\xff"  # `head[2]` of both of the vendor's structures
_COMMAND_HEAD = struct.Struct("<2siB")
_STATE_HEAD = struct.Struct("<2si")
_POSE = struct.Struct("<6d")
_TRAJECTORY = struct.Struct("<i12d3di")  # 128 of the 140 bytes; the rest is unused
BODY_SIZE = COMMAND_SIZE - _COMMAND_HEAD.size
"""Bytes of a command after its head, whose meaning depends on the state."""
_JOINTS_AT = _STATE_HEAD.size
_POSE_AT = _JOINTS_AT + z1.N_JOINTS * JOINT_STATE.itemsize
_LABEL_SIZE = 10  # `char name[10]`, without a terminating zero at full length
_MAX_POSE = 1e2  # [rad, m]; far beyond any Z1, so that only garbage is rejected
_STATES = frozenset(Fsm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryCommand:
    """Move of the gripper pivot: roll, pitch, yaw [rad] (R = Rz·Ry·Rx) and x, y, z [m] in the base frame."""

    kind: int = 0
    """Unused by the controller; may hold garbage."""
    poses: np.ndarray = field(default_factory=lambda: np.zeros((2, 6)))
    """(2, 6) the goal; MOVEC passes through the first and ends in the second."""
    gripper_rad: float = 0.0
    """Gripper angle at the end [rad]."""
    max_speed: float = 0.0
    """Maximum speed of the joints in MOVEJ [rad/s], of the pivot in MOVEL and MOVEC [m/s]."""
    stop_time_s: float = 0.0
    """Stop time [s]; ignored by the twin."""
    order: int = 0
    """Number of this piece in SETTRAJ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A decoded command; its body is decoded later, once its meaning is known."""

    state: Fsm
    """Requested state; INVALID keeps the present one."""
    track: bool
    """Whether the body is a tracking target, in JOINTCTRL and CARTESIAN."""
    body: bytes
    """140 bytes."""

    def joints(self) -> JointCommands:
        """Decode the body as seven joints' commands (LOWCMD, and tracking in JOINTCTRL).

        Raises:
            ProtocolError: a value is not finite.
        """
        return unpack_commands(np.frombuffer(self.body, JOINT_CMD))

    def trajectory(self) -> TrajectoryCommand:
        """Decode the body as a move (MOVEJ, MOVEL, MOVEC, SETTRAJ, and tracking in CARTESIAN).

        Raises:
            ProtocolError: a value is not finite.
        """
        kind, *numbers, order = _TRAJECTORY.unpack_from(self.body)
        values = np.array(numbers)
        if not np.isfinite(values).all():
            bad = values[~np.isfinite(values)][:3]
            raise ProtocolError(f"a move holds values that are not finite: {bad}.", code="not_finite")
        return TrajectoryCommand(
            kind=kind,
            poses=values[:12].reshape(2, 6),
            gripper_rad=float(values[12]),
            max_speed=float(values[13]),
            stop_time_s=float(values[14]),
            order=order,
        )

    def label(self) -> str:
        """Decode the body as a label (TOSTATE, SAVESTATE, TEACH, TEACHREPEAT).

        Raises:
            ProtocolError: not 1 to 10 printable ASCII characters.
        """
        name = self.body[:_LABEL_SIZE].split(b"\0", 1)[0]
        if not name or not all(0x20 <= byte < 0x7F for byte in name):
            raise ProtocolError(
                f"a label is {name!r}; allowed are 1 to {_LABEL_SIZE} printable ASCII characters.", code="label"
            )
        return name.decode("ascii")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerState:
    """Answer of the controller."""

    state: Fsm
    """Present state."""
    joints: JointStates
    """The seven joints; repeated unchanged while the motor board is silent."""
    pose: np.ndarray
    """(6,) roll, pitch, yaw [rad] and x, y, z [m] of the gripper pivot in the base frame."""


class CommandBuffer:
    """One command in a buffer that is reused, so that the servo loop allocates nothing; `data` is sent."""

    def __init__(self) -> None:
        self.data = bytearray(COMMAND_SIZE)
        self.joints = np.frombuffer(self.data, JOINT_CMD, z1.N_JOINTS, offset=_COMMAND_HEAD.size)
        """Records (7,) of `JOINT_CMD` inside `data`: assign to them."""
        self.set_head(Fsm.INVALID, track=False)

    def set_head(self, state: Fsm, *, track: bool) -> None:
        """Set the requested state, and whether the joints are a tracking target."""
        _COMMAND_HEAD.pack_into(self.data, 0, _HEAD, state, track)


def encode_command(
    state: Fsm, body: JointCommands | TrajectoryCommand | str | None = None, *, track: bool = False
) -> bytes:
    """Return a command of 147 B.

    Raises:
        ProtocolError: a value that is not finite, a label that is too long, not seven joints.
    """
    match body:
        case None:
            packed = b""
        case str():
            packed = _pack_label(body)
        case JointCommands():
            packed = pack_commands(body).tobytes()
        case TrajectoryCommand():
            packed = _pack_trajectory(body)
    if len(packed) > BODY_SIZE:
        raise ProtocolError(f"a command's body has {len(packed)} bytes; allowed are {BODY_SIZE}.", code="wrong_size")
    return _COMMAND_HEAD.pack(_HEAD, state, track) + packed.ljust(BODY_SIZE, b"\0")


def decode_command(data: bytes | memoryview) -> Command:
    """Return the command in a datagram.

    As lenient as the vendor's controller (measured): bytes after the 147th are cut off, every track flag but 0 tracks,
    and an unknown state requests no change.

    Raises:
        ProtocolError: too short, or another head.
    """
    if len(data) < COMMAND_SIZE:
        raise ProtocolError(f"a command has {len(data)} bytes; allowed are {COMMAND_SIZE} or more.", code="wrong_size")
    head, state, track = _COMMAND_HEAD.unpack_from(data)
    _check_head(head)
    body = bytes(data[_COMMAND_HEAD.size : COMMAND_SIZE])
    return Command(state=Fsm(state) if state in _STATES else Fsm.INVALID, track=bool(track), body=body)


def encode_state(state: ControllerState) -> bytes:
    """Return a state of 208 B.

    Raises:
        ProtocolError: a value that is not finite, or not seven joints.
    """
    if not np.isfinite(state.pose).all():
        raise ProtocolError(f"the pose is {state.pose}; it must be finite.", code="not_finite")
    joints = pack_states(state.joints).tobytes()
    data = _STATE_HEAD.pack(_HEAD, state.state) + joints + _POSE.pack(*state.pose)
    _check_size(data, STATE_SIZE, "a state")
    return data


def decode_state(data: bytes | memoryview) -> ControllerState:
    """Return the state in a datagram, which is copied.

    Raises:
        ProtocolError: wrong size, head or state, or a value that no Z1 can have.
    """
    _check_size(data, STATE_SIZE, "a state")
    head, state = _STATE_HEAD.unpack_from(data)
    _check_head(head)
    if state not in _STATES:
        raise ProtocolError(f"a datagram has state {state}; allowed are 0 to {max(_STATES)}.", code="unknown_state")
    pose = np.array(_POSE.unpack_from(data, _POSE_AT))
    if not (np.abs(pose) <= _MAX_POSE).all():  # true for a NaN, too
        raise ProtocolError(
            f"the gripper's pose is {pose}; allowed are finite values within ±{_MAX_POSE:g}.", code="implausible_value"
        )
    records = np.frombuffer(bytes(data[_JOINTS_AT:_POSE_AT]), JOINT_STATE)  # a copy: the link reuses its buffer
    return ControllerState(state=Fsm(state), joints=unpack_states(records), pose=pose)


def _pack_label(label: str) -> bytes:
    packed = label.encode("ascii", "replace")  # `isascii` below rejects the replaced ones
    if not 1 <= len(packed) <= _LABEL_SIZE or not label.isascii() or not label.isprintable():
        raise ProtocolError(
            f"the label {label!r} cannot be sent; allowed are 1 to {_LABEL_SIZE} printable ASCII characters.",
            code="label",
        )
    return packed


def _pack_trajectory(move: TrajectoryCommand) -> bytes:
    numbers = [*np.asarray(move.poses, dtype=float).ravel(), move.gripper_rad, move.max_speed, move.stop_time_s]
    if not np.isfinite(numbers).all():
        raise ProtocolError(f"a move holds values that are not finite: {numbers}.", code="not_finite")
    return _TRAJECTORY.pack(move.kind, *numbers, move.order)


def _check_size(data: bytes | memoryview, size: int, name: str) -> None:
    if len(data) != size:
        raise ProtocolError(f"{name} has {len(data)} bytes; allowed are {size}.", code="wrong_size")


def _check_head(head: bytes) -> None:
    if head != _HEAD:
        raise ProtocolError(f"a datagram begins with {head.hex()}; allowed is {_HEAD.hex()}.", code="wrong_head")

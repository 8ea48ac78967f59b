"""The client's wire protocol, byte by byte, against golden bytes written by hand from its description."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest

from hal.z1_protocol import controller, records
from hal.z1_protocol.controller import Command, CommandBuffer, ControllerState, TrajectoryCommand
from hal.z1_protocol.records import JointCommands, JointStates, ProtocolError
from hal.z1_protocol.states import Fsm
from tests.support.errors import raises

# head FE FF, state 2 (JOINTCTRL), track 1, then joint1: tau 1.0, dq 0.5, q -2.0, kp 20.0, kd 2000.0
GOLDEN_COMMAND = bytes.fromhex("feff 02000000 01 0000803f 0000003f 000000c0 0000a041 0000fa44") + bytes(120)
# head FE FF, state 16 (LOWCMD), joint1: tau 1.0, dq 0.5, ddq 0.0, q -2.0, motors (25 °C, overheat, lost), (-1, 0, CRC)
GOLDEN_STATE = (
    bytes.fromhex("feff 10000000 0000803f 0000003f 00000000 000000c0 19 04 40 ff 00 80")
    + bytes(132)
    + bytes.fromhex(
        "0000000000000000 000000000000f03f 0000000000000000 000000000000e03f 0000000000000000 0000000000000040"
    )
)


def one_joint(value: float) -> np.ndarray:
    return np.array([value, 0, 0, 0, 0, 0, 0], dtype=float)


def golden_state() -> ControllerState:
    motors = {name: np.zeros((7, 2), dtype=int) for name in ("temperature_c", "error", "link")}
    motors["temperature_c"][0] = (25, -1)
    motors["error"][0] = (0x04, 0)
    motors["link"][0] = (1, 2)
    joints = JointStates(tau=one_joint(1.0), dq=one_joint(0.5), q=one_joint(-2.0), **motors)
    return ControllerState(state=Fsm.LOWCMD, joints=joints, pose=np.array([0, 1.0, 0, 0.5, 0, 2.0]))


def patch(data: bytes, at: int, value: bytes) -> bytes:
    return data[:at] + value + data[at + len(value) :]


def test_the_records_have_the_sizes_that_were_measured() -> None:
    assert records.JOINT_CMD.itemsize == 20
    assert records.JOINT_STATE.itemsize == 22
    assert records.MOTOR.itemsize == 3
    assert len(controller.encode_command(Fsm.INVALID)) == controller.COMMAND_SIZE == 147
    assert len(controller.encode_state(golden_state())) == controller.STATE_SIZE == 208


def test_states_have_their_numbers_on_the_wire() -> None:
    names = (
        "INVALID PASSIVE JOINTCTRL CARTESIAN MOVEJ MOVEL MOVEC TRAJECTORY TOSTATE SAVESTATE TEACH TEACHREPEAT "
        "CALIBRATION SETTRAJ BACKTOSTART NEXT LOWCMD"
    )
    assert [state.name for state in sorted(Fsm)] == names.split()
    assert list(map(int, sorted(Fsm))) == list(range(17))


def test_joint_commands_are_the_golden_bytes_in_both_directions() -> None:
    joints = JointCommands(
        tau=one_joint(1.0), dq=one_joint(0.5), q=one_joint(-2.0), kp=one_joint(20.0), kd=one_joint(2000.0)
    )
    assert controller.encode_command(Fsm.JOINTCTRL, joints, track=True) == GOLDEN_COMMAND
    command = controller.decode_command(GOLDEN_COMMAND)
    assert (command.state, command.track) == (Fsm.JOINTCTRL, True)
    read = command.joints()
    for name in ("tau", "dq", "q", "kp", "kd"):
        assert getattr(read, name) == pytest.approx(getattr(joints, name))


def test_a_buffer_writes_the_same_bytes_without_making_new_ones() -> None:
    buffer = CommandBuffer()
    data = buffer.data
    buffer.set_head(Fsm.JOINTCTRL, track=True)
    for name, value in (("tau", 1.0), ("dq", 0.5), ("q", -2.0), ("kp", 20.0), ("kd", 2000.0)):
        buffer.joints[name] = one_joint(value)
    assert bytes(buffer.data) == GOLDEN_COMMAND
    assert buffer.data is data


def test_a_new_buffer_requests_no_state_change() -> None:
    assert bytes(CommandBuffer().data) == b"\xfe\xff" + bytes(145)


def test_states_are_the_golden_bytes_in_both_directions() -> None:
    assert controller.encode_state(golden_state()) == GOLDEN_STATE
    read = controller.decode_state(GOLDEN_STATE)
    assert read.state is Fsm.LOWCMD
    assert read.pose == pytest.approx([0, 1.0, 0, 0.5, 0, 2.0])
    assert (read.joints.tau[0], read.joints.dq[0], read.joints.q[0]) == (1.0, 0.5, -2.0)
    assert read.joints.temperature_c[0].tolist() == [25, -1]
    assert read.joints.error[0].tolist() == [4, 0]
    assert read.joints.link[0].tolist() == [1, 2]


def test_the_low_bits_of_a_motors_link_are_reserved_and_ignored() -> None:
    read = controller.decode_state(patch(GOLDEN_STATE, 24, b"\x7f"))
    assert read.joints.link[0].tolist() == [1, 2]


def test_a_move_has_the_measured_layout() -> None:
    move = TrajectoryCommand(
        kind=-7, poses=np.arange(12.0).reshape(2, 6), gripper_rad=-1.0, max_speed=0.3, stop_time_s=0.1, order=5
    )
    data = controller.encode_command(Fsm.MOVEC, move)
    assert data[:11] == bytes.fromhex("feff 06000000 00 f9ffffff")
    assert struct.unpack_from("<15di", data, 11) == (*map(float, range(12)), -1.0, 0.3, 0.1, 5)
    assert data[135:] == bytes(12)  # 128 of the 140 bytes are used
    read = controller.decode_command(data).trajectory()
    assert (read.kind, read.gripper_rad, read.max_speed, read.stop_time_s, read.order) == (-7, -1.0, 0.3, 0.1, 5)
    assert read.poses == pytest.approx(move.poses)


def test_a_label_has_the_measured_layout() -> None:
    data = controller.encode_command(Fsm.TOSTATE, "startFlat")
    assert data == bytes.fromhex("feff 08000000 00") + b"startFlat" + bytes(131)
    assert controller.decode_command(data).label() == "startFlat"
    full = controller.encode_command(Fsm.TOSTATE, "0123456789")
    assert controller.decode_command(full).label() == "0123456789"
    assert controller.decode_command(controller.encode_command(Fsm.TOSTATE, "my label")).label() == "my label"


@pytest.mark.parametrize("label", ["", "01234567890", "grün", "a\nb"])
def test_a_label_that_cannot_be_sent_is_rejected(label: str) -> None:
    with raises(ProtocolError, "label"):
        controller.encode_command(Fsm.TOSTATE, label)


@pytest.mark.parametrize("body", [bytes(140), b"\xff" * 140])
def test_a_body_without_a_label_is_rejected(body: bytes) -> None:
    with raises(ProtocolError, "label"):
        Command(state=Fsm.TOSTATE, track=False, body=body).label()


@pytest.mark.parametrize("size", [0, 1, 6, 146])
def test_a_command_that_is_too_short_is_rejected(size: int) -> None:
    with raises(ProtocolError, "wrong_size") as caught:
        controller.decode_command(GOLDEN_COMMAND[:size])
    assert f"{size} bytes; allowed are 147" in str(caught.value)


@pytest.mark.parametrize("size", [148, 208, 1500, 65_000])
def test_a_longer_command_is_cut_as_the_vendors_controller_cuts_it(size: int) -> None:
    assert controller.decode_command((GOLDEN_COMMAND * 500)[:size]) == controller.decode_command(GOLDEN_COMMAND)


@pytest.mark.parametrize("size", [0, 1, 5, 147, 207, 209, 65_000])
def test_a_state_of_a_wrong_size_is_rejected(size: int) -> None:
    with raises(ProtocolError, "wrong_size"):
        controller.decode_state((GOLDEN_STATE * 400)[:size])


def test_a_command_with_another_head_is_rejected() -> None:
    with raises(ProtocolError, "wrong_head"):
        controller.decode_command(patch(GOLDEN_COMMAND, 0, b"\x00"))


def test_an_unknown_state_requests_none_and_every_flag_tracks() -> None:
    for state in (b"\x11", b"\xff\xff\xff\xff"):
        assert controller.decode_command(patch(GOLDEN_COMMAND, 2, state)).state is Fsm.INVALID
    assert controller.decode_command(patch(GOLDEN_COMMAND, 6, b"\x02")).track


@pytest.mark.parametrize(
    ("at", "value", "code"),
    [
        (1, b"\x00", "wrong_head"),
        (2, b"\x11", "unknown_state"),
        (6, struct.pack("<f", np.nan), "implausible_value"),
        (10, struct.pack("<f", np.inf), "implausible_value"),
        (14, struct.pack("<f", 2e6), "implausible_value"),
        (18 + 6 * 22, struct.pack("<f", -101.0), "implausible_value"),
        (6, bytes.fromhex("0100807f"), "implausible_value"),  # a signalling NaN
        (160, struct.pack("<d", np.nan), "implausible_value"),
        (200, struct.pack("<d", 1e300), "implausible_value"),
    ],
)
def test_a_state_with_an_implausible_field_is_rejected(at: int, value: bytes, code: str) -> None:
    with warnings.catch_warnings(), raises(ProtocolError, code):
        warnings.simplefilter("error")
        controller.decode_state(patch(GOLDEN_STATE, at, value))


def test_a_command_body_that_is_not_finite_is_rejected_when_decoded() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for value in (struct.pack("<f", np.nan), bytes.fromhex("0100807f"), struct.pack("<f", -np.inf)):
            with raises(ProtocolError, "not_finite"):
                controller.decode_command(patch(GOLDEN_COMMAND, 15, value)).joints()
        with raises(ProtocolError, "not_finite"):
            controller.decode_command(patch(GOLDEN_COMMAND, 11, struct.pack("<d", np.nan))).trajectory()


def test_values_that_are_not_finite_are_never_sent() -> None:
    with raises(ProtocolError, "not_finite"):
        controller.encode_command(Fsm.LOWCMD, JointCommands(tau=one_joint(1e300)))
    with raises(ProtocolError, "not_finite"):
        controller.encode_command(Fsm.MOVEJ, TrajectoryCommand(max_speed=np.nan))
    with raises(ProtocolError, "not_finite"):
        controller.encode_state(
            ControllerState(state=Fsm.PASSIVE, joints=JointStates(q=one_joint(np.nan)), pose=np.zeros(6))
        )


def test_a_body_that_is_too_long_is_never_sent() -> None:
    with raises(ProtocolError, "wrong_size"):
        controller.encode_command(Fsm.LOWCMD, JointCommands(**{n: np.zeros(8) for n in ("q", "dq", "tau", "kp", "kd")}))


def test_random_datagrams_are_decoded_or_rejected_and_nothing_else() -> None:
    """100,000 packets: random bytes of random sizes, and good packets with a few bytes changed."""
    rng = np.random.default_rng(5)
    outcomes = {"read": 0, "rejected": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(50_000):
            for golden, read in ((GOLDEN_STATE, controller.decode_state), (GOLDEN_COMMAND, read_command)):
                data = bytearray(golden) if i % 4 else bytearray(rng.bytes(int(rng.integers(0, 300))))
                if i % 4:
                    for at in rng.integers(0, len(data), 1 + i % 3):
                        data[at] = rng.integers(0, 256)
                try:
                    read(bytes(data))
                    outcomes["read"] += 1
                except ProtocolError:
                    outcomes["rejected"] += 1
    assert sum(outcomes.values()) == 100_000
    assert min(outcomes.values()) > 10_000


def read_command(data: bytes) -> None:
    command = controller.decode_command(data)
    for read in (command.joints, command.trajectory, command.label):
        try:
            read()
        except ProtocolError:
            continue

"""The vendor's controller on the twin's physics: datagrams in, datagrams out."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_kinematics import pose_from_posture
from hal.z1_protocol.controller import LABELS, decode_state, encode_command
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm
from sim_twin.controller.client_port import CYCLE_S, QUEUE_LENGTH
from sim_twin.controller.controlled_world import ControlledWorld
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.hal.ideal_arm import make_body, move_to, pose_at


@pytest.fixture
def twin() -> ControlledWorld:
    return ControlledWorld(World(SceneConfig()))


def run(twin: ControlledWorld, duration_s: float) -> np.ndarray:
    for _ in range(round(duration_s / 0.002)):
        twin.tick()
        twin.world.step()
    return twin.world.read_arm()[0]


def send(twin: ControlledWorld, data: bytes) -> None:
    """Send a command, and again with the same body but no request, as the vendor's library does."""
    twin.receive(data)
    run(twin, 0.012)
    twin.receive(data[:2] + bytes(4) + data[6:])


@pytest.mark.integration
def test_one_datagram_is_read_and_answered_a_cycle_and_the_others_queue(twin: ControlledWorld) -> None:
    answers = 0
    for _ in range(5000):
        twin.receive(encode_command(Fsm.INVALID))
        run(twin, 0.002)
        answers += twin.reply() is not None
    assert answers == pytest.approx(10.0 / CYCLE_S, abs=2)
    assert twin.port.backlog == pytest.approx(5000 - answers, abs=2)


def test_a_backlog_delays_a_request_by_its_length(twin: ControlledWorld) -> None:
    backlog = 100
    for _ in range(backlog):
        twin.receive(encode_command(Fsm.INVALID))
    twin.receive(encode_command(Fsm.JOINTCTRL))
    run(twin, (backlog - 5) * CYCLE_S)
    assert twin.controller.fsm is Fsm.PASSIVE
    run(twin, 15 * CYCLE_S)
    assert twin.controller.fsm is Fsm.JOINTCTRL


def test_a_full_queue_drops_the_newest(twin: ControlledWorld) -> None:
    for _ in range(QUEUE_LENGTH):
        twin.receive(encode_command(Fsm.INVALID))
    twin.receive(encode_command(Fsm.JOINTCTRL))
    assert twin.port.dropped == 1
    run(twin, 1.2 * QUEUE_LENGTH * CYCLE_S)
    assert twin.controller.fsm is Fsm.PASSIVE


@pytest.mark.integration
@pytest.mark.parametrize("state", [Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.LOWCMD, Fsm.TEACH, Fsm.TOSTATE])
def test_silence_ends_in_passive_and_the_answers_go_on(twin: ControlledWorld, state: Fsm) -> None:
    if state not in (Fsm.CARTESIAN, Fsm.LOWCMD):
        send(twin, encode_command(Fsm.JOINTCTRL))
    send(twin, encode_command(state, make_body(state)))
    run(twin, 0.02)
    assert twin.controller.fsm is (Fsm.JOINTCTRL if state is Fsm.INVALID else state)
    answers, silent_s = [], 0.0
    while twin.controller.fsm is not Fsm.PASSIVE and silent_s < 5.0:
        run(twin, 0.002)
        silent_s += 0.002
        answers += [twin.reply()]
    assert 2.1 < silent_s < 2.3
    assert sum(answer is not None for answer in answers) == pytest.approx(22, abs=2)
    run(twin, 0.2)
    assert decode_state(twin.answer).state is Fsm.PASSIVE


@pytest.mark.integration
def test_any_datagram_restarts_the_watchdog(twin: ControlledWorld) -> None:
    send(twin, encode_command(Fsm.JOINTCTRL))
    for _ in range(10):
        twin.receive(bytes(146))
        run(twin, 0.5)
    assert twin.controller.fsm is Fsm.JOINTCTRL
    assert twin.invalid_datagrams == 10


@pytest.mark.integration
def test_longer_packets_and_other_track_flags_are_obeyed(twin: ControlledWorld) -> None:
    send(twin, encode_command(Fsm.JOINTCTRL) + b"x")
    assert twin.controller.fsm is Fsm.JOINTCTRL
    q = decode_state(twin.answer).joints.q + np.eye(7)[0] * 0.1
    command = bytearray(encode_command(Fsm.INVALID, JointCommands(q=q), track=True))
    command[6] = 2
    twin.receive(bytes(command))
    assert run(twin, 0.5)[0] == pytest.approx(q[0], abs=0.01)


@pytest.mark.integration
def test_the_arm_stays_parked_until_the_first_command_and_then_sinks(twin: ControlledWorld) -> None:
    parked = run(twin, 0.5)
    assert not twin.port.connected
    twin.receive(encode_command(Fsm.INVALID))
    assert np.abs(run(twin, 0.5) - parked).max() > 0.1


@pytest.mark.integration
def test_joint_control_carries_the_arm_and_movej_reaches_its_goal(twin: ControlledWorld) -> None:
    before = twin.world.read_arm()[0]
    send(twin, encode_command(Fsm.JOINTCTRL))
    assert np.abs(run(twin, 0.5) - before).max() < 0.01
    goal = pose_at(LABELS["forward"])
    send(twin, encode_command(Fsm.MOVEJ, move_to(goal, gripper=-1.0, speed=1.5)))
    max_speed = 0.0
    while twin.controller.fsm is Fsm.MOVEJ:
        twin.receive(encode_command(Fsm.INVALID))
        run(twin, 0.01)
        max_speed = max(max_speed, float(np.abs(twin.world.read_arm()[1]).max()))
    assert max_speed < 1.6
    run(twin, 0.5)
    assert pose_from_posture(twin.controller.answer().pose) == pytest.approx(pose_from_posture(goal), abs=0.01)


def test_a_torque_beyond_the_motors_is_passed_on_and_ends_at_their_effort_limit(twin: ControlledWorld) -> None:
    tau = np.zeros(7)
    tau[0] = 700.0
    send(twin, encode_command(Fsm.LOWCMD, JointCommands(q=twin.world.read_arm()[0], tau=tau)))
    run(twin, 0.004)
    assert twin.world.read_arm()[2][0] == pytest.approx(z1.TAU_MAX[0])


def test_about_every_second_answer_repeats_the_measurement(twin: ControlledWorld) -> None:
    answers = []
    for _ in range(100):
        twin.receive(encode_command(Fsm.INVALID))
        run(twin, 0.002)
        answers += [answer] if (answer := twin.reply()) else []
    repeats = sum(a == b for a, b in pairwise(answers[5:]))
    assert repeats == pytest.approx(len(answers) / 2, abs=4)


def test_a_silent_board_leaves_stale_answers_and_is_recovered_from(twin: ControlledWorld) -> None:
    send(twin, encode_command(Fsm.INVALID))  # in PASSIVE it sinks
    run(twin, 0.1)
    twin.motors.silent = True
    run(twin, 0.01)
    stale = twin.answer
    run(twin, 0.5)
    assert twin.answer == stale
    twin.motors.silent = False
    run(twin, 0.01)
    assert twin.answer != stale


@pytest.mark.integration
def test_gains_beyond_all_reason_do_not_break_the_physics(twin: ControlledWorld) -> None:
    big = np.full(7, 3e38)
    send(twin, encode_command(Fsm.LOWCMD, JointCommands(q=big, dq=-big, tau=-big, kp=big, kd=big)))
    run(twin, 0.5)
    send(twin, encode_command(Fsm.INVALID, JointCommands(kp=-big, kd=-big)))
    q = run(twin, 0.5)
    assert np.isfinite(q).all()
    assert twin.world.data.time > 0.9  # MuJoCo resets its state when it diverges
    assert not twin.world.data.warning.number.any()
    send(twin, encode_command(Fsm.JOINTCTRL))
    assert twin.controller.fsm is Fsm.JOINTCTRL


@pytest.mark.integration
def test_random_bytes_and_mutilated_commands_are_counted_and_never_crash(twin: ControlledWorld) -> None:
    rng = np.random.default_rng(5)
    goods = [encode_command(state, make_body(state), track=bool(state % 2)) for state in Fsm]
    for i in range(3000):
        data = bytearray(goods[rng.integers(len(goods))])
        for _ in range(rng.integers(1, 8)):
            data[rng.integers(len(data))] = rng.integers(256)
        data = (bytes(data), bytes(data[: rng.integers(147)]), rng.bytes(int(rng.integers(0, 400))))[i % 3]
        twin.receive(data)
        run(twin, 0.004)
        assert len(twin.answer) == 208
    assert twin.invalid_datagrams >= 2000
    assert twin.invalid_reason
    assert np.isfinite(twin.world.read_arm()[0]).all()


def test_the_worlds_own_servos_resume_from_released_motors(twin: ControlledWorld) -> None:
    send(twin, encode_command(Fsm.LOWCMD))  # neither stiffness nor torque: it falls
    q = run(twin, 0.1)
    assert np.abs(twin.world.read_arm()[1]).max() > 0.5
    twin.world.set_command(q, np.zeros(7))
    for _ in range(500):
        twin.world.step()
    assert np.abs(twin.world.read_arm()[0] - q).max() < 0.02

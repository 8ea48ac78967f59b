"""The twin's motors: what they make of commands, how warm they get, and what they do when something is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from hal.backends.z1.torque_limits import FeedForward
from hal.base import z1
from hal.z1_protocol.controller import KD_JOINTCTRL, KP_JOINTCTRL
from hal.z1_protocol.records import JointCommands, MotorError, MotorLink
from sim_twin.controller.motors import AMBIENT_C, HEATING_K, HEATING_S, OVERHEAT_C, SILENCE_S, Motors
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World

START = np.append(z1.Q_HOME, -1.0)


@pytest.fixture
def motors() -> Motors:
    return Motors(World(SceneConfig()))


def holding(q: np.ndarray = START) -> JointCommands:
    """Return what holds the arm at `q` (7,): stiffness, damping and its weight."""
    tau = FeedForward().torque(q, np.zeros(7))
    return JointCommands(q=q, tau=tau, kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)


def run(motors: Motors, duration_s: float, commands: JointCommands | None = None) -> np.ndarray:
    """Let time pass, with a command every 4 ms if there is one; return where the arm is."""
    for i in range(round(duration_s / 0.002)):
        if commands is not None and i % 2 == 0:
            motors.obey(commands)
        motors.tick()
        motors.world.step()
    return motors.world.read_arm()[0]


def test_a_motor_makes_torque_and_spring_and_damper(motors: Motors) -> None:
    run(motors, 0.1, holding())
    q, dq, _ = motors.world.read_arm()
    command = JointCommands(q=q + 0.01, dq=np.full(7, 0.1), tau=np.full(7, 1.0), kp=np.full(7, 10.0), kd=np.full(7, 50))
    motors.obey(command)
    motors.world.step()
    # MuJoCo integrates the damper implicitly: over one period the torque follows the joint a little.
    wanted = 1.0 + 25.6 * 10.0 * 0.01 + 0.0128 * 50 * (0.1 - dq)
    assert motors.measure().tau[[0, 3, 5]] == pytest.approx(wanted[[0, 3, 5]], abs=0.35)


def test_no_motor_makes_more_than_its_effort_limit(motors: Motors) -> None:
    motors.obey(JointCommands(q=START, tau=np.full(7, 700.0)))
    motors.world.step()
    assert motors.measure().tau == pytest.approx(z1.TAU_MAX)


def test_six_commands_move_the_arm_and_leave_the_gripper_limp(motors: Motors) -> None:
    c = holding()
    six = JointCommands(**{name: getattr(c, name)[:6] for name in ("q", "dq", "tau", "kp", "kd")})
    q = run(motors, 0.5, six)
    assert q[:6] == pytest.approx(START[:6], abs=0.02)
    assert motors.measure().tau[6] == pytest.approx(0.0, abs=0.05)


def test_a_motor_that_hears_nothing_lets_go_after_a_while_and_obeys_again(motors: Motors) -> None:
    held = run(motors, 0.3, holding())
    assert run(motors, SILENCE_S - 0.004) == pytest.approx(held, abs=0.01)
    assert np.abs(run(motors, 0.5) - held).max() > 0.1
    assert np.abs(motors.world.read_arm()[1]).max() < 3.0  # damped
    sunk = motors.world.read_arm()[0]
    assert run(motors, 0.5, holding(sunk)) == pytest.approx(sunk, abs=0.05)


def test_a_lost_motor_lets_its_joint_go_and_tells_its_last(motors: Motors) -> None:
    run(motors, 0.2, holding())
    motors.link[3, 0] = MotorLink.LOST
    told = motors.measure().q[3]
    run(motors, 0.6, holding())
    assert abs(motors.world.read_arm()[0][3] - START[3]) > 0.05
    assert motors.measure().q[3] == told
    assert motors.measure().link[3, 0] == MotorLink.LOST
    motors.link[3, 0] = MotorLink.OK
    run(motors, 0.5, holding())
    assert motors.measure().q[3] == pytest.approx(START[3], abs=0.02)


def test_with_one_of_its_two_motors_joint_2_has_half_its_torque(motors: Motors) -> None:
    motors.error[1, 1] = MotorError.OVER_CURRENT
    motors.obey(JointCommands(q=START, tau=np.full(7, 700.0)))
    motors.world.step()
    assert motors.measure().tau[1] == pytest.approx(z1.TAU_MAX[1] / 2)
    assert run(motors, 0.5, holding())[1] == pytest.approx(START[1], abs=0.5)


def test_a_fault_that_stops_nothing_is_only_told(motors: Motors) -> None:
    motors.error[:] = MotorError.LEAKAGE | MotorError.IGNORE
    assert run(motors, 0.5, holding()) == pytest.approx(START, abs=0.02)
    assert (motors.measure().error == MotorError.LEAKAGE | MotorError.IGNORE).all()


def test_motors_warm_up_with_the_square_of_their_torque(motors: Motors) -> None:
    motors.obey(JointCommands(q=START, tau=np.full(7, 15.0)))
    motors.world.step()
    tau = motors.world.read_arm()[2]
    for _ in range(10):
        motors.warm(HEATING_S)
    assert motors.measure().temperature_c[0, 0] == round(AMBIENT_C + HEATING_K * (tau[0] / 30.0) ** 2)
    assert motors.measure().temperature_c[1] == pytest.approx(AMBIENT_C + HEATING_K * (tau[1] / 60.0) ** 2, abs=0.6)


def test_a_motor_that_is_too_hot_says_so_and_lets_go_until_it_is_switched_off_and_on(motors: Motors) -> None:
    run(motors, 0.2, holding())
    motors.temperature_c[0, 0] = OVERHEAT_C + 1.0
    run(motors, 0.1, holding())
    pushing = holding(START + 0.3 * np.eye(7)[0])
    assert run(motors, 0.5, pushing)[0] == pytest.approx(START[0], abs=0.02)
    assert motors.measure().error[0, 0] == MotorError.OVERHEAT
    motors.temperature_c[:] = AMBIENT_C
    assert run(motors, 0.2, pushing)[0] == pytest.approx(START[0], abs=0.02)
    motors.error[:] = 0
    assert run(motors, 1.0, pushing)[0] == pytest.approx(START[0] + 0.3, abs=0.02)

"""The twin's motors: torques, temperatures and faults."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_dynamics import FeedForward
from hal.z1_protocol.controller import KD_JOINTCTRL, KP_JOINTCTRL
from hal.z1_protocol.records import JointCommands, MotorError, MotorLink
from sim_twin.controller.motors import AMBIENT_C, COMMAND_TIMEOUT_S, HEATING_K, HEATING_S, OVERHEAT_C, Motors
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World

START = np.append(z1.Q_HOME, -1.0)


@pytest.fixture
def motors() -> Motors:
    return Motors(World(SceneConfig()))


def make_hold(q: np.ndarray = START) -> JointCommands:
    """Return the commands that hold the arm at `q` (7,): stiffness, damping and gravity compensation."""
    tau = FeedForward().torque(q, np.zeros(7))
    return JointCommands(q=q, tau=tau, kp=KP_JOINTCTRL, kd=KD_JOINTCTRL)


def run(motors: Motors, duration_s: float, commands: JointCommands | None = None) -> np.ndarray:
    """Advance by `duration_s`, with a command every 4 ms if there is one; return the arm's positions."""
    for i in range(round(duration_s / 0.002)):
        if commands is not None and i % 2 == 0:
            motors.handle_command(commands)
        motors.tick()
        motors.world.step()
    return motors.world.read_arm()[0]


def test_a_motor_makes_torque_and_spring_and_damper(motors: Motors) -> None:
    run(motors, 0.1, make_hold())
    q, dq, _ = motors.world.read_arm()
    command = JointCommands(q=q + 0.01, dq=np.full(7, 0.1), tau=np.full(7, 1.0), kp=np.full(7, 10.0), kd=np.full(7, 50))
    motors.handle_command(command)
    motors.world.step()
    # MuJoCo integrates the damper implicitly: over one period the torque follows the joint a little.
    expected = 1.0 + 25.6 * 10.0 * 0.01 + 0.0128 * 50 * (0.1 - dq)
    assert motors.measure().tau[[0, 3, 5]] == pytest.approx(expected[[0, 3, 5]], abs=0.35)


def test_no_motor_makes_more_than_its_effort_limit(motors: Motors) -> None:
    motors.handle_command(JointCommands(q=START, tau=np.full(7, 700.0)))
    motors.world.step()
    assert motors.measure().tau == pytest.approx(z1.TAU_MAX)


def test_six_commands_move_the_arm_and_leave_the_gripper_without_torque(motors: Motors) -> None:
    c = make_hold()
    six = JointCommands(**{name: getattr(c, name)[:6] for name in ("q", "dq", "tau", "kp", "kd")})
    q = run(motors, 0.5, six)
    assert q[:6] == pytest.approx(START[:6], abs=0.02)
    assert motors.measure().tau[6] == pytest.approx(0.0, abs=0.05)


def test_a_motor_without_commands_releases_its_joint_and_recovers(motors: Motors) -> None:
    held = run(motors, 0.3, make_hold())
    assert run(motors, COMMAND_TIMEOUT_S - 0.004) == pytest.approx(held, abs=0.01)
    assert np.abs(run(motors, 0.5) - held).max() > 0.1
    assert np.abs(motors.world.read_arm()[1]).max() < 3.0  # damped
    sunk = motors.world.read_arm()[0]
    assert run(motors, 0.5, make_hold(sunk)) == pytest.approx(sunk, abs=0.05)


def test_a_lost_motor_releases_its_joint_and_repeats_its_last_measurement(motors: Motors) -> None:
    run(motors, 0.2, make_hold())
    motors.link[3, 0] = MotorLink.LOST
    reported = motors.measure().q[3]
    run(motors, 0.6, make_hold())
    assert abs(motors.world.read_arm()[0][3] - START[3]) > 0.05
    assert motors.measure().q[3] == reported
    assert motors.measure().link[3, 0] == MotorLink.LOST
    motors.link[3, 0] = MotorLink.OK
    run(motors, 0.5, make_hold())
    assert motors.measure().q[3] == pytest.approx(START[3], abs=0.02)


def test_with_one_of_its_two_motors_joint_2_has_half_its_torque(motors: Motors) -> None:
    motors.error[1, 1] = MotorError.OVER_CURRENT
    motors.handle_command(JointCommands(q=START, tau=np.full(7, 700.0)))
    motors.world.step()
    assert motors.measure().tau[1] == pytest.approx(z1.TAU_MAX[1] / 2)
    assert run(motors, 0.5, make_hold())[1] == pytest.approx(START[1], abs=0.5)


def test_a_fault_that_stops_nothing_is_only_reported(motors: Motors) -> None:
    motors.error[:] = MotorError.LEAKAGE | MotorError.IGNORE
    assert run(motors, 0.5, make_hold()) == pytest.approx(START, abs=0.02)
    assert (motors.measure().error == MotorError.LEAKAGE | MotorError.IGNORE).all()


def test_motors_warm_up_with_the_square_of_their_torque(motors: Motors) -> None:
    motors.handle_command(JointCommands(q=START, tau=np.full(7, 15.0)))
    motors.world.step()
    tau = motors.world.read_arm()[2]
    for _ in range(10):
        motors.heat(HEATING_S)
    assert motors.measure().temperature_c[0, 0] == round(AMBIENT_C + HEATING_K * (tau[0] / 30.0) ** 2)
    assert motors.measure().temperature_c[1] == pytest.approx(AMBIENT_C + HEATING_K * (tau[1] / 60.0) ** 2, abs=0.6)


def test_an_overheated_motor_releases_its_joint_until_its_error_is_cleared(motors: Motors) -> None:
    run(motors, 0.2, make_hold())
    motors.temperature_c[0, 0] = OVERHEAT_C + 1.0
    run(motors, 0.1, make_hold())
    pushing = make_hold(START + 0.3 * np.eye(7)[0])
    assert run(motors, 0.5, pushing)[0] == pytest.approx(START[0], abs=0.02)
    assert motors.measure().error[0, 0] == MotorError.OVERHEAT
    motors.temperature_c[:] = AMBIENT_C
    assert run(motors, 0.2, pushing)[0] == pytest.approx(START[0], abs=0.02)
    motors.error[:] = 0
    assert run(motors, 1.0, pushing)[0] == pytest.approx(START[0] + 0.3, abs=0.02)

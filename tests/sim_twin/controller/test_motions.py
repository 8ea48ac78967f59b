"""Motions of the controller: their paths, and their durations as measured on the vendor's controller."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base import z1
from hal.z1_protocol.controller import LABELS, TrajectoryCommand
from hal.z1_protocol.motor_board import PERIOD_S
from hal.z1_protocol.states import Fsm
from tests.support.hal.ideal_arm import START, IdealArm, move_to, pose_at, shift

START_FLAT = np.append(LABELS["startFlat"], -0.5)
FORWARD = np.append(LABELS["forward"], -0.5)
UP, AWAY, NOD = (0, 0, 0, -0.1, 0.15, 0.1), (0, 0, 0, -0.1, 0.25, 0.1), (0, 0.6, 0, 0, 0, 0)
QUARTER = ((0, 0, 0, 0, 0.0707, 0.0293), (0, 0, 0, 0, 0.1, 0.1))
HALF = ((0, 0, 0, 0, 0.05, 0.05), (0, 0, 0, 0, 0, 0.1))


@pytest.fixture
def arm() -> IdealArm:
    return IdealArm()


def move_by(*steps: tuple[float, ...], speed: float) -> TrajectoryCommand:
    """Return a move relative to the pose at `forward`."""
    return move_to(*(shift(pose_at(FORWARD), *step) for step in steps), speed=speed)


def durations() -> list[tuple[Fsm, TrajectoryCommand | str | None, np.ndarray, float]]:
    """Return state, body, start and the duration on the vendor's controller [s]."""
    return [
        (Fsm.TOSTATE, "forward", START_FLAT, 1.87),
        (Fsm.TOSTATE, "show_left", FORWARD, 1.37),
        (Fsm.BACKTOSTART, None, FORWARD, 1.87),
        *((Fsm.MOVEJ, move_by(UP, speed=v), FORWARD, t) for v, t in ((0.5, 1.74), (1, 1.11), (2, 0.925), (0, 1.11))),
        *((Fsm.MOVEL, move_by(UP, speed=v), FORWARD, t) for v, t in ((0.1, 2.51), (0.3, 1.49), (3, 1.49), (0, 1.49))),
        *((Fsm.MOVEL, move_by(AWAY, speed=v), FORWARD, t) for v, t in ((0.1, 3.32), (0.3, 1.81), (0.5, 1.66))),
        *((Fsm.MOVEL, move_by(NOD, speed=v), FORWARD, t) for v, t in ((0.1, 6.32), (0.3, 2.55), (1, 1.69))),
        *((Fsm.MOVEC, move_by(*QUARTER, speed=v), FORWARD, t) for v, t in ((0.1, 4.91), (0.5, 1.39), (1, 1.15))),
        *((Fsm.MOVEC, move_by(*HALF, speed=v), FORWARD, t) for v, t in ((0.1, 1.77), (0.5, 0.80), (0, 0.88))),
    ]


@pytest.mark.integration
def test_motions_take_as_long_as_on_the_vendors_controller() -> None:
    for state, body, start, expected_s in durations():
        arm = IdealArm(start)
        arm.request(Fsm.JOINTCTRL)
        assert arm.request(state, body) is state
        steps = 1
        while arm.controller.fsm is state and steps * PERIOD_S < 10.0:
            arm.run(PERIOD_S)
            steps += 1
        assert steps * PERIOD_S == pytest.approx(expected_s, rel=0.1), (state, body)


def test_movej_reaches_its_goal_within_the_requested_speed(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    goal = pose_at(LABELS["forward"])
    arm.request(Fsm.MOVEJ, move_to(goal, gripper=-1.0, speed=0.8))
    arm.finish()
    assert arm.pose == pytest.approx(goal, abs=1e-6)
    assert arm.states.q[6] == pytest.approx(-1.0)
    assert 0.7 < arm.max_speed <= 0.8 + 1e-6
    assert (arm.states.q >= z1.Q_MIN).all()
    assert (arm.states.q <= z1.Q_MAX).all()


@pytest.mark.parametrize("state", [Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC], ids=lambda s: s.name)
def test_a_pose_out_of_reach_gives_joint_control_at_once_and_no_motion(arm: IdealArm, state: Fsm) -> None:
    arm.request(Fsm.CARTESIAN)
    for far in (2.0, 1e300):
        assert arm.request(state, move_to(np.array([0, 0, 0, far, 0, 0.4]), pose_at(START))) is state
        arm.run(2 * PERIOD_S)
        assert arm.controller.fsm is Fsm.JOINTCTRL
    arm.run(0.2)
    assert arm.states.q == pytest.approx(START)


def test_a_move_without_speed_takes_the_controllers_own(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.MOVEJ, move_to(pose_at(LABELS["show_right"]), speed=0.0))
    arm.finish()
    assert arm.max_speed == pytest.approx(1.0, abs=0.01)


def test_movel_keeps_to_the_line(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    start = pose_at(START)
    goal = shift(start, 0, 0, 0, -0.05, 0.10, 0.05)
    arm.request(Fsm.MOVEL, move_to(goal, speed=0.1))
    line, poses, before = (goal - start)[3:], [], start[3:]
    while arm.controller.fsm is Fsm.MOVEL:
        arm.run(0.02)
        poses.append(arm.pose)
        assert np.linalg.norm(poses[-1][3:] - before) <= 0.1 * 0.02 + 1e-4
        before = poses[-1][3:]
    assert poses[-1] == pytest.approx(goal, abs=1e-5)
    distances = [np.linalg.norm(np.cross(p[3:] - start[3:], line)) / np.linalg.norm(line) for p in poses]
    assert max(distances) < 5e-4


def test_movec_reaches_the_end_of_half_a_circle_without_turning(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    start = pose_at(START)
    centre = shift(start, 0, 0, 0, 0, 0.05, 0)
    middle, end = shift(centre, 0.3, 0, 0, -0.05, 0, 0), shift(centre, 0.6, 0, 0, 0, 0.05, 0)
    arm.request(Fsm.MOVEC, move_to(middle, end, speed=0.1))
    radii, nearest = [], 1.0
    while arm.controller.fsm is Fsm.MOVEC:
        arm.run(0.02)
        radii.append(np.linalg.norm((arm.pose - centre)[3:]))
        nearest = min(nearest, float(np.linalg.norm((arm.pose - middle)[3:])))
    assert radii == pytest.approx(np.full(len(radii), 0.05), abs=5e-4)
    assert nearest < 2e-3
    assert arm.pose == pytest.approx(shift(centre, 0, 0, 0, 0, 0.05, 0), abs=1e-5)


def test_movec_sweeps_the_complement_of_another_arc(arm: IdealArm) -> None:
    """Measured: a quarter of a circle becomes three quarters."""
    arm = IdealArm(FORWARD)
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.MOVEC, move_by(*QUARTER, speed=0.5))
    arm.finish()
    assert arm.pose == pytest.approx(shift(pose_at(FORWARD), 0, 0, 0, 0, -0.1, 0.1), abs=1e-3)


def test_movec_through_three_points_on_a_line_runs_on_and_never_ends(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    start = pose_at(START)
    middle, end = shift(start, 0, 0, 0, 0, 0.02, 0), shift(start, 0, 0, 0, 0, 0.04, 0)
    arm.request(Fsm.MOVEC, move_to(middle, end, speed=0.3))
    arm.run(5.0)
    assert arm.controller.fsm is Fsm.MOVEC
    assert arm.pose[4] - start[4] > 0.2
    assert arm.request(Fsm.BACKTOSTART) is Fsm.BACKTOSTART


def test_the_demonstration_goes_to_both_sides_for_ever(arm: IdealArm) -> None:
    arm.request(Fsm.JOINTCTRL)
    arm.request(Fsm.TRAJECTORY)
    visited = []
    for _ in range(60):
        arm.run(0.2)
        visited.append(arm.states.q)
    assert arm.controller.fsm is Fsm.TRAJECTORY
    later = np.array(visited[20:])
    assert later[:, 0].min() < -0.9
    assert later[:, 0].max() > 0.9
    assert later[:, 6].min() < -0.9
    assert arm.request(Fsm.NEXT) is Fsm.BACKTOSTART

"""The safety guard, alone and below the servo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.base import z1
from hal.base.errors import GuardError, InvalidValueError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1 import GRIPPER_POINTS
from hal.servo.guard import Guard, Workspace, segment_distance
from tests.support.errors import raises
from tests.support.hal.servo_bench import START, Bench, move, setpoint

HOME = np.append(z1.Q_HOME, -1.0)
FOLDED = np.zeros(z1.N_JOINTS)
LOW = np.append([0.0, 2.2, -0.9, 0.3, 0.0, 1.57], -0.5)
"""A posture with the gripper below the table's plane."""


@pytest.fixture(scope="module")
def guard() -> Guard:
    return Guard()


def pivot(q: np.ndarray) -> np.ndarray:
    import pinocchio as pin

    model = pin.buildModelFromUrdf(str(z1.urdf_path()))
    data = model.createData()
    full = np.zeros(model.nq)
    full[: len(q)] = q[: model.nq]
    pin.framesForwardKinematics(model, data, full)
    return data.oMf[model.getFrameId("link06")].homogeneous @ z1.T_FLANGE_PIVOT


@pytest.mark.integration
@given(st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7))
def test_its_kinematics_are_the_urdfs(ratios: list[float]) -> None:
    q = z1.Q_MIN + np.array(ratios) * (z1.Q_MAX - z1.Q_MIN)
    # A box with one side far off and the other a plane through the base: the margin is a coordinate.
    space = Guard(Workspace(lower_m=(0.0, -9.0, -9.0), upper_m=(9.0, 9.0, 9.0)))
    q[6] = 0.0
    T = pivot(q)
    corners = GRIPPER_POINTS @ T[:3, :3].T + T[:3, 3]
    expected = corners[:, 0].min()
    assert float(space.compute_margins(q[None]).box_m[0]) <= expected + 1e-9


@given(st.lists(st.floats(-1.0, 1.0), min_size=12, max_size=12))
def test_segment_distance_is_the_minimum_over_both(numbers: list[float]) -> None:
    a, b, c, d = np.array(numbers).reshape(4, 3)
    if min(np.linalg.norm(b - a), np.linalg.norm(d - c)) < 0.01:
        return
    s, t = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60))
    gaps = a + s[..., None] * (b - a) - c - t[..., None] * (d - c)
    minimum = np.linalg.norm(gaps, axis=-1).min()
    step = (np.linalg.norm(b - a) + np.linalg.norm(d - c)) / 60
    assert minimum - step <= segment_distance(a, b, c, d) <= minimum + 1e-9


def test_home_and_the_folded_pose_are_allowed(guard: Guard) -> None:
    for q in (HOME, FOLDED):
        assert guard.find_violation(q[None], q) is None
        assert min(float(m[0]) for m in guard.compute_margins(q[None])) > 0.0


def test_a_posture_below_the_table_is_a_violation_with_its_depth(guard: Guard) -> None:
    violation = guard.find_violation(np.array([HOME, LOW]), HOME)
    assert violation is not None
    assert (violation.index, violation.code) == (1, "table")
    depth_mm = -1e3 * float(guard.compute_margins(LOW[None]).table_m[0])
    assert f"{depth_mm:.0f} mm" in violation.text


def test_a_posture_in_self_collision_is_a_violation(guard: Guard) -> None:
    q = np.append([0.0, 1.44, -0.06, 1.4, 0.6, 0.23], -1.0)
    assert code_of(guard, q) == "self_collision"


def test_a_gripper_outside_the_box_is_a_violation() -> None:
    small = Guard(Workspace(lower_m=(0.2, -0.3, 0.0), upper_m=(0.7, 0.3, 0.6)))
    turned = HOME.copy()
    turned[0] = 1.2
    assert small.find_violation(HOME[None], HOME) is None
    assert code_of(small, turned) == "workspace"


def code_of(guard: Guard, q: np.ndarray) -> str:
    """Return the code of the posture's violation, starting from home; empty when there is none."""
    violation = guard.find_violation(q[None], HOME)
    return violation.code if violation else ""


def test_an_arm_that_is_outside_already_may_come_back_but_not_go_further(guard: Guard) -> None:
    up, down = LOW.copy(), LOW.copy()
    up[1] -= 0.05
    down[1] += 0.05
    assert guard.find_violation(up[None], LOW) is None
    assert guard.find_violation(LOW[None], LOW) is None
    assert guard.find_violation(down[None], LOW) is not None


@pytest.mark.parametrize(("lower", "upper"), [((1.0, 0, 0), (0.0, 1, 1)), ((0, 0, np.nan), (1, 1, 1))])
def test_an_inverted_or_non_finite_box_is_rejected(lower: tuple, upper: tuple) -> None:
    with raises(InvalidValueError, "invalid_workspace"):
        Workspace(lower_m=lower, upper_m=upper)


# --- Below the servo ------------------------------------------------------------------------------------------------


def straight_down() -> TrajectoryChunk:
    return move(start=START, step=LOW - START, duration_s=4.0)


def test_a_trajectory_through_the_table_is_rejected_and_nothing_moves(guard: Guard) -> None:
    bench = Bench(guard=guard)
    with raises(GuardError, "table") as caught:
        bench.servo.stream(straight_down())
    for part in ("mm below the table's plane", "at t = ", "Plan inside the workspace"):
        assert part in str(caught.value)
    bench.run(0.1)
    assert bench.mode is ServoMode.HOLDING
    assert np.array_equal(bench.commanded()[-1], START)


@pytest.mark.integration
def test_a_later_chunk_through_the_table_is_rejected_and_the_arm_brakes_before_it(guard: Guard) -> None:
    bench = Bench(guard=guard)
    whole = straight_down()
    rejected = False
    for piece in (slice(i, i + 6) for i in range(0, len(whole.t_s), 5)):
        chunk = TrajectoryChunk(trajectory_id=1, t_s=whole.t_s[piece], q=whole.q[piece], dq=whole.dq[piece])
        try:
            bench.servo.stream(chunk)
        except GuardError:
            rejected = True
            break
        bench.run(0.08)
    assert rejected
    bench.run(1.0)
    assert bench.mode is ServoMode.HOLDING
    assert "below the table's plane" in bench.reason
    # It brakes on the buffered part of the path, which ends before the table.
    assert guard.compute_margins(bench.commanded()).table_m.min() > 0.0
    assert distance_from_path(bench.commanded(), whole) < 1e-5


def distance_from_path(q: np.ndarray, path: TrajectoryChunk) -> float:
    """Return the maximum distance of the postures `q` (N, 7) from `path`, a straight line in joint space [rad]."""
    along = path.q[-1] - path.q[0]
    along /= np.linalg.norm(along)
    off = q - path.q[0]
    return float(np.abs(off - np.outer(off @ along, along)).max())


def test_a_setpoint_below_the_table_is_rejected(guard: Guard) -> None:
    bench = Bench(guard=guard)
    with raises(GuardError, "table"):
        bench.servo.send(setpoint(LOW))


def test_a_motion_to_a_setpoint_is_braked_before_it_leaves_the_workspace() -> None:
    """Both ends are inside, but between them the gripper swings out through the front of the box."""
    left, right = START.copy(), START.copy()
    left[0], right[0] = -0.3, 0.3
    front_m = 0.9
    wide = Guard(Workspace(upper_m=(front_m, 0.9, 1.2)))
    side, middle = (float(wide.compute_margins(q[None]).box_m[0]) for q in (left, START))
    assert middle < side
    fence = Guard(Workspace(upper_m=(front_m - (side + middle) / 2, 0.9, 1.2)))
    bench = Bench(start=left, guard=fence)
    reasons = set()
    for _ in range(20):
        bench.servo.send(setpoint(right))
        bench.run(0.05, lambda: reasons.add(bench.reason))
    assert any("the motion to the setpoint moves the gripper" in reason for reason in reasons)
    assert bench.commanded()[-1][0] < 0.0
    assert fence.compute_margins(bench.commanded()).box_m.min() > -3e-3  # 1 mm of slack, and what the jerk takes

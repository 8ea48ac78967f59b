"""The guard's space, by itself and below the servo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.base import z1
from hal.base.errors import CommandRejectedError
from hal.base.messages import ServoMode, TrajectoryChunk
from hal.base.z1_shape import GRIPPER_POINTS
from hal.servo.guard import Guard, Workspace
from hal.servo.guard_kernels import segment_distance
from tests.support.hal.servo_bench import START, Bench, move, setpoint

HOME = np.append(z1.Q_HOME, -1.0)
FOLDED = np.zeros(z1.N_JOINTS)
LOW = np.append([0.0, 2.2, -0.9, 0.3, 0.0, 1.57], -0.5)
"""The hand under the table's plane."""


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


@given(st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7))
def test_its_kinematics_are_the_urdfs(shares: list[float]) -> None:
    q = z1.Q_MIN + np.array(shares) * (z1.Q_MAX - z1.Q_MIN)
    # A box of which one side stands far off and the other is a plane through the base: the margin is a coordinate.
    space = Guard(Workspace(lower_m=(0.0, -9.0, -9.0), upper_m=(9.0, 9.0, 9.0)))
    q[6] = 0.0
    T = pivot(q)
    corners = GRIPPER_POINTS @ T[:3, :3].T + T[:3, 3]
    expected = corners[:, 0].min()
    assert float(space.compute_margins(q[None]).box_m[0]) <= expected + 1e-9


@given(st.lists(st.floats(-1.0, 1.0), min_size=12, max_size=12))
def testsegment_distance_is_the_least_over_both(numbers: list[float]) -> None:
    a, b, c, d = np.array(numbers).reshape(4, 3)
    if min(np.linalg.norm(b - a), np.linalg.norm(d - c)) < 0.01:
        return
    s, t = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60))
    gaps = a + s[..., None] * (b - a) - c - t[..., None] * (d - c)
    least = np.linalg.norm(gaps, axis=-1).min()
    step = (np.linalg.norm(b - a) + np.linalg.norm(d - c)) / 60
    assert least - step <= segment_distance(a, b, c, d) <= least + 1e-9


def test_home_and_the_folded_pose_are_allowed(guard: Guard) -> None:
    for q in (HOME, FOLDED):
        assert guard.find_violation(q[None], q) is None
        assert min(float(m[0]) for m in guard.compute_margins(q[None])) > 0.0


def test_a_posture_below_the_table_is_refused_with_the_depth(guard: Guard) -> None:
    index, what = guard.find_violation(np.array([HOME, LOW]), HOME) or (-1, "")
    assert index == 1
    assert "below the table" in what
    depth_mm = -1e3 * float(guard.compute_margins(LOW[None]).table_m[0])
    assert f"{depth_mm:.0f} mm" in what


def test_a_posture_that_runs_into_the_arm_itself_is_refused(guard: Guard) -> None:
    q = np.append([0.0, 1.44, -0.06, 1.4, 0.6, 0.23], -1.0)
    assert "too near to each other" in (guard.find_violation(q[None], HOME) or (0, ""))[1]


def test_a_hand_outside_the_box_is_refused() -> None:
    small = Guard(Workspace(lower_m=(0.2, -0.3, 0.0), upper_m=(0.7, 0.3, 0.6)))
    aside = HOME.copy()
    aside[0] = 1.2
    assert small.find_violation(HOME[None], HOME) is None
    assert "workspace box" in (small.find_violation(aside[None], HOME) or (0, ""))[1]


def test_an_arm_that_is_outside_already_may_come_back_but_not_go_further(guard: Guard) -> None:
    up, down = LOW.copy(), LOW.copy()
    up[1] -= 0.05
    down[1] += 0.05
    assert guard.find_violation(up[None], LOW) is None
    assert guard.find_violation(LOW[None], LOW) is None
    assert guard.find_violation(down[None], LOW) is not None


@pytest.mark.parametrize(("lower", "upper"), [((1.0, 0, 0), (0.0, 1, 1)), ((0, 0, np.nan), (1, 1, 1))])
def test_a_box_that_is_none_is_refused(lower: tuple, upper: tuple) -> None:
    with pytest.raises(ValueError, match="lower_m below upper_m"):
        Workspace(lower_m=lower, upper_m=upper)


# --- Below the servo ------------------------------------------------------------------------------------------------


def straight_down() -> TrajectoryChunk:
    return move(start=START, step=LOW - START, duration_s=4.0)


def test_a_trajectory_through_the_table_is_refused_and_nothing_moves(guard: Guard) -> None:
    bench = Bench(guard=guard)
    with pytest.raises(CommandRejectedError, match=r"below the table's plane \(t = \d"):
        bench.servo.stream(straight_down())
    bench.run(0.1)
    assert bench.mode is ServoMode.HOLDING
    assert np.array_equal(bench.commanded()[-1], START)


def test_a_later_chunk_through_the_table_is_refused_and_the_arm_brakes_before_it(guard: Guard) -> None:
    bench = Bench(guard=guard)
    whole = straight_down()
    refused = False
    for piece in (slice(i, i + 6) for i in range(0, len(whole.t_s), 5)):
        chunk = TrajectoryChunk(trajectory_id=1, t_s=whole.t_s[piece], q=whole.q[piece], dq=whole.dq[piece])
        try:
            bench.servo.stream(chunk)
        except CommandRejectedError:
            refused = True
            break
        bench.run(0.08)
    assert refused
    bench.run(1.0)
    assert bench.mode is ServoMode.HOLDING
    assert "below the table's plane" in bench.reason
    # It brakes on the part of the way that was allowed, which ends before the table.
    assert guard.compute_margins(bench.commanded()).table_m.min() > 0.0
    assert off_the_way(bench.commanded(), whole) < 1e-5


def off_the_way(q: np.ndarray, way: TrajectoryChunk) -> float:
    """How far the postures `q` (N, 7) are from the straight line in joint space that `way` follows [rad]."""
    along = way.q[-1] - way.q[0]
    along /= np.linalg.norm(along)
    off = q - way.q[0]
    return float(np.abs(off - np.outer(off @ along, along)).max())


def test_a_setpoint_below_the_table_is_refused(guard: Guard) -> None:
    bench = Bench(guard=guard)
    with pytest.raises(CommandRejectedError, match=r"the setpoint goes .* below the table"):
        bench.servo.send(setpoint(LOW))


def test_the_way_to_a_setpoint_is_braked_before_it_leads_outside() -> None:
    """Both ends are inside, but between them the hand swings out through the front of the box."""
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
    assert any("the way to the setpoint takes the hand" in reason for reason in reasons)
    assert bench.commanded()[-1][0] < 0.0
    assert fence.compute_margins(bench.commanded()).box_m.min() > -3e-3  # 1 mm of slack, and what the jerk takes

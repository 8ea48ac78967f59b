"""Views of a calibration board: in reach, in view, free, and turned in every way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.board.board import Board
from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse, pose_error, transform_points
from tests.support.errors import raises
from z1_runtime.calibration_session.viewpoints import (
    NoViewpointsError,
    Viewpoint,
    ViewpointConfig,
    find_viewpoints,
    make_table_checker,
    plan_free_motion,
    scan_scene,
)
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.trajectory import MotionLimits

BOARD = Board()
INTRINSICS = Intrinsics(width=160, height=120, fx=98.26, fy=98.17, cx=78.0, cy=60.0)
HOME = np.append(z1.Q_HOME, z1.GRIPPER_CLOSED)
CONFIG = ViewpointConfig(n=8, n_drawn=400, border_px=3.0)


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


def frame_from_home(kinematics: Kinematics, box: tuple[np.ndarray, np.ndarray] | None = None) -> RgbdFrame:
    """Return a frame from home of the table and, where given, of an upright box (lower, upper corner in base)."""
    T = kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA
    i = INTRINSICS
    v, u = np.mgrid[0 : i.height, 0 : i.width]
    rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0.0, -T[2, 3] / rays[..., 2], 0.0)
        if box is not None:
            low, high = ((bound - T[:3, 3]) / rays for bound in box)
            enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
            depth = np.where((enter < leave) & (enter > 0.0), enter, depth)
    depth = np.where(depth < 2.0, depth, 0.0)
    colour = np.zeros((i.height, i.width, 3), np.uint8)
    return RgbdFrame(colour=colour, depth_m=depth, intrinsics=i, stamp_s=0.0, sequence=0)


def flat_board(x_m: float, y_m: float) -> np.ndarray:
    """Return T_base_board of a board whose upper left corner is there and whose upper edge is the far one."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    T[:3, 3] = [x_m, y_m, 0.003]
    return T


@pytest.fixture(scope="module")
def checker(kinematics: Kinematics) -> CollisionChecker:
    return scan_scene(kinematics, frame_from_home(kinematics), HOME)


def views_of(kinematics: Kinematics, checker: CollisionChecker, T_base_board: np.ndarray, **options) -> list[Viewpoint]:
    options = {"q_start": HOME, "config": CONFIG, **options}
    return find_viewpoints(kinematics, checker, INTRINSICS, T_base_board, BOARD.corners_m, **options)


@pytest.mark.integration
def test_each_view_has_its_camera_pose_and_the_board_in_view(kinematics, checker):
    T_base_board = flat_board(0.495, 0.10)
    for view in views_of(kinematics, checker, T_base_board):
        reached = kinematics.flange(view.q[:6]) @ z1.T_FLANGE_CAMERA
        assert np.allclose(reached, view.T_base_camera, atol=1e-6)
        assert ((view.q >= z1.Q_MIN) & (view.q <= z1.Q_MAX)).all() and view.q[-1] == z1.GRIPPER_CLOSED
        points = transform_points(inverse(reached) @ T_base_board, BOARD.corners_m)
        u, v = (INTRINSICS.K @ (points / points[:, 2:]).T)[:2]
        inside = (u > 0) & (u < INTRINSICS.width) & (v > 0) & (v < INTRINSICS.height)
        assert inside.mean() >= view.visible_ratio >= CONFIG.min_visible_ratio
        tilt_deg = np.rad2deg(np.arccos(reached[:3, 2] @ T_base_board[:3, 2]))
        assert tilt_deg <= CONFIG.max_tilt_deg + 1e-6
        assert checker.check_posture(view.q) is None


def test_views_turn_about_more_than_one_axis_and_none_comes_twice(kinematics, checker):
    views = views_of(kinematics, checker, flat_board(0.495, 0.10))
    assert len(views) == CONFIG.n
    pairs = [pose_error(a.T_base_camera, b.T_base_camera) for i, a in enumerate(views) for b in views[:i]]
    assert min(np.hypot(angle, distance / 0.35) for distance, angle in pairs) > 0.3
    first = views[0].T_base_camera[:3, :3]
    turns = [np.linalg.svd(first.T @ view.T_base_camera[:3, :3] - np.eye(3))[2][-1] for view in views[1:]]
    assert np.linalg.svd(np.array(turns), compute_uv=False)[-1] > 0.3  # axes of turning span space


@pytest.mark.integration
def test_the_same_arguments_give_the_same_views_and_another_seed_others(kinematics, checker):
    one, same, other = (views_of(kinematics, checker, flat_board(0.495, 0.10), seed=seed) for seed in (0, 0, 1))
    assert all(np.array_equal(a.q, b.q) for a, b in zip(one, same, strict=True))
    assert not all(np.array_equal(a.q, b.q) for a, b in zip(one, other, strict=True))


@pytest.mark.integration
def test_views_keep_a_distance_from_existing_ones(kinematics, checker):
    existing = [view.T_base_camera for view in views_of(kinematics, checker, flat_board(0.495, 0.10))]
    more = views_of(kinematics, checker, flat_board(0.495, 0.10), existing=existing, config=replace(CONFIG, n=3))
    for view in more:
        distances = [pose_error(T, view.T_base_camera) for T in existing]
        assert min(np.hypot(angle, distance / 0.35) for distance, angle in distances) > 0.2


def test_board_out_of_reach_is_rejected_with_counted_reasons(kinematics, checker):
    with raises(NoViewpointsError, "no_viewpoints") as caught:
        views_of(kinematics, checker, flat_board(1.0, 0.4))
    message = str(caught.value)
    assert "of 400 sampled views" in message and "out of reach" in message and "0.35 to 0.5 m" in message


def test_obstacles_on_the_table_are_avoided(kinematics, checker):
    box = (np.array([0.50, -0.20, 0.0]), np.array([0.60, 0.20, 0.30]))
    walled = scan_scene(kinematics, frame_from_home(kinematics, box), HOME)
    assert len(walled.scene.scene_index) > 100 and len(checker.scene.scene_index) == 0
    T_pivot = np.eye(4)
    T_pivot[:3, 3] = [0.50, 0.0, 0.25]  # the tips reach 0.1 m beyond: into the box
    q = np.append(kinematics.best(T_pivot).q, 0.0)
    limits = MotionLimits()
    assert plan_free_motion(checker, HOME, q, limits) is not None
    assert plan_free_motion(walled, HOME, q, limits) is None


@pytest.mark.integration
def test_free_motion_ends_at_rest_at_its_goal(kinematics, checker):
    view = views_of(kinematics, checker, flat_board(0.495, 0.10))[-1]
    motion = plan_free_motion(checker, HOME, view.q, MotionLimits())
    assert motion is not None
    assert np.allclose(motion.q[0], HOME) and np.allclose(motion.q[-1], view.q) and not motion.dq[-1].any()


def test_motion_home_may_start_close_to_the_table(kinematics, checker):
    T_pivot = np.eye(4)
    T_pivot[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]  # pointing down
    T_pivot[:3, 3] = [0.40, 0.0, 0.110]  # tips 10 mm over the table
    low = np.append(kinematics.best(T_pivot).q, 0.0)
    assert plan_free_motion(checker, low, HOME, MotionLimits()) is None
    assert (
        plan_free_motion(make_table_checker(kinematics, frame_from_home(kinematics), low), low, HOME, MotionLimits())
        is not None
    )


@pytest.mark.parametrize("wrong", [{"n": 0}, {"distance_m": (0.3, 0.2)}, {"max_tilt_deg": 90.0}, {"n": 5000}])
def test_values_out_of_range_are_rejected(wrong: dict):
    with raises(InvalidValueError, "invalid_value"):
        ViewpointConfig(**wrong)


@pytest.mark.integration
def test_joints_follow_the_assumed_extrinsics(kinematics, checker):
    moved = z1.T_FLANGE_CAMERA.copy()
    moved[:3, 3] += [0.0, 0.01, 0.0]
    view = views_of(kinematics, checker, flat_board(0.495, 0.10), T_flange_camera=moved)[0]
    assert np.allclose(inverse(kinematics.flange(view.q[:6])) @ view.T_base_camera, moved, atol=1e-6)

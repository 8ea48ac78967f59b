"""The board on the twin's table: rendered at its pose by either renderer, over the whole range of use."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.board.board import Board
from calibration.board.detection import detect_board
from hal.base import z1
from hal.base.errors import InvalidValueError
from sim_twin.backends import make_rig
from sim_twin.camera import d405
from sim_twin.camera.render import make_renderer
from sim_twin.ground_truth import read_ground_truth
from sim_twin.model.charuco_board import THICKNESS_M, BoardSpec
from sim_twin.model.scene import SceneConfig, build_model
from sim_twin.model.world import World
from tests.support.errors import raises
from tests.support.gl_here import needs_egl

BOARD = Board()
SPEC = BoardSpec(image=BOARD.image(100), size_m=BOARD.size_m, x_m=0.42, y_m=0.05, yaw_deg=20.0)
RENDERERS = [pytest.param("egl", marks=needs_egl), "rays"]


@pytest.fixture(scope="module")
def world() -> World:
    """The board's world, its arm turned away from the board."""
    world = World(SceneConfig(board=SPEC))
    world.data.qpos[0] = 2.5
    return world


def view_from(world: World, distance_m: float, tilt_deg: float, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the noisy picture of the board from `distance_m` and `tilt_deg`, and T_camera_board."""
    c, s = np.cos(np.deg2rad(tilt_deg)), np.sin(np.deg2rad(tilt_deg))
    T_board_camera = np.eye(4)
    T_board_camera[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    T_board_camera[:3, 3] = [*(np.array(SPEC.size_m) / 2), 0.0] - distance_m * T_board_camera[:3, 2]
    T_base_camera = SPEC.T_base_board() @ T_board_camera
    data, camera = world.snapshot(), world.model.camera("wrist").id
    data.cam_xpos[camera] = T_base_camera[:3, 3]
    data.cam_xmat[camera] = (T_base_camera[:3, :3] * [1.0, -1.0, -1.0]).ravel()
    renderer = make_renderer(world.model, d405.INTRINSICS, kind, SPEC)
    try:
        colour = renderer.render(data).colour
    finally:
        renderer.close()
    return d405.measure_colour(colour, seed=0, sequence=1), np.linalg.inv(T_board_camera)


@pytest.mark.integration
@pytest.mark.parametrize("kind", RENDERERS)
@pytest.mark.parametrize(("distance_m", "tilt_deg"), [(0.15, 0.0), (0.22, 35.0), (0.30, 50.0), (0.40, 40.0)])
def test_corners_are_detected_where_they_are_to_a_fraction_of_a_pixel(
    world: World, kind: str, distance_m: float, tilt_deg: float
):
    picture, T_camera_board = view_from(world, distance_m, tilt_deg, kind)
    view = detect_board(picture, BOARD)
    assert len(view.ids) >= 15
    points = BOARD.corners_m[view.ids] @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    i = d405.INTRINSICS
    true_px = points[:, :2] / points[:, 2:] * [i.fx, i.fy] + [i.cx, i.cy]
    off_px = view.pixels_px - true_px
    assert np.sqrt((off_px**2).sum(axis=1).mean()) < 0.2
    assert np.abs(off_px.mean(axis=0)).max() < 0.06  # no shift of the whole picture


def test_the_pose_is_right_handed_and_its_origin_the_corner_of_the_print():
    T = SPEC.T_base_board()
    assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3)) and np.linalg.det(T[:3, :3]) > 0.0
    middle = T @ [*(np.array(SPEC.size_m) / 2), 0.0, 1.0]
    assert np.allclose(middle[:2], [0.42, 0.05]) and abs(middle[2] - THICKNESS_M) < 1e-4
    unturned = BoardSpec(image=SPEC.image, size_m=SPEC.size_m).T_base_board()
    assert np.allclose(unturned[:3, :3] @ [0.0, -1.0, 0.0], [1.0, 0.0, 0.0])  # its upper edge is the far one


def test_the_board_can_be_touched_and_the_object_is_out_of_reach(world: World):
    assert world.model.geom("board_plate").contype != 0
    assert np.linalg.norm(world.T_base_object()[:2, 3]) > 1.0  # the arm ends at 0.74 m
    truth = read_ground_truth(world)
    assert truth.T_base_board is not None and np.array_equal(truth.T_base_board, SPEC.T_base_board())
    assert read_ground_truth(World(SceneConfig())).T_base_board is None


@pytest.mark.integration
def test_a_mount_off_its_drawing_is_off_by_what_was_asked_and_has_a_serial_of_its_own():
    moved = SceneConfig(mount_error_m=0.005, mount_error_deg=2.0, mount_seed=3)
    T = moved.T_flange_camera()
    assert np.linalg.norm(T[:3, 3] - z1.T_FLANGE_CAMERA[:3, 3]) == pytest.approx(0.005)
    turn = T[:3, :3] @ z1.T_FLANGE_CAMERA[:3, :3].T
    assert np.rad2deg(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(2.0)
    assert np.array_equal(SceneConfig().T_flange_camera(), z1.T_FLANGE_CAMERA)
    model = build_model(moved)
    assert np.allclose(model.body("camera").pos, T[:3, 3])
    serials = {SceneConfig(mount_error_m=0.005, mount_seed=seed).camera_serial() for seed in range(3)}
    assert len(serials | {SceneConfig().camera_serial()}) == 4


@pytest.mark.integration
@needs_egl
def test_every_frame_has_the_camera_s_serial_number():
    config = SceneConfig(mount_error_deg=1.0)
    camera = make_rig(config, lockstep=True).camera
    camera.connect()
    try:
        assert camera.wait_for_frame(1.0).serial == config.camera_serial()
    finally:
        camera.disconnect()


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"image": np.zeros((4, 4, 3), np.uint8)}, "board_image"),
        ({"image": np.zeros((4, 4))}, "board_image"),
        ({"size_m": (0.2, 2.0)}, "board_size"),
        ({"x_m": 1.0}, "board_position"),
        ({"y_m": float("nan")}, "board_position"),
        ({"yaw_deg": float("inf")}, "board_yaw"),
    ],
)
def test_an_invalid_board_is_rejected(wrong: dict, code: str):
    with raises(InvalidValueError, code):
        BoardSpec(**{"image": SPEC.image, "size_m": SPEC.size_m, **wrong})


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"mount_error_m": 0.1}, "scene_range"),
        ({"mount_error_deg": -1.0}, "scene_range"),
        ({"mount_seed": -1}, "scene_seed"),
    ],
)
def test_an_invalid_mount_is_rejected(wrong: dict, code: str):
    with raises(InvalidValueError, code):
        SceneConfig(**wrong)

"""Synthetic samples with their ground truth: an arm with scatter, a camera, a board, and corners with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calibration.board.board import Board
from calibration.board.detection import BoardView
from calibration.board.pose import estimate_board_pose
from calibration.camera_model import CameraModel
from calibration.hand_eye.solver import Refinement
from hal.base.transforms import apply_increment, inverse, make_pose, transform_points

BOARD = Board()
CAMERA = CameraModel.pinhole(fx=393.0305, fy=392.6793, cx=312.918, cy=240.937, width=640, height=480)


def pose(rotation_deg: tuple[float, float, float], position_m: tuple[float, float, float]) -> np.ndarray:
    """Return the (4, 4) pose of Euler angles about x, y, z and a position."""
    return make_pose(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix(), np.array(position_m))


T_FLANGE_CAMERA = pose((-100.0, 5.0, -88.0), (0.06, -0.01, 0.07))
T_BASE_BOARD = pose((180.0, 0.0, 30.0), (0.35, 0.1, 0.0))


@dataclass(frozen=True)
class Recording:
    """The samples of a capture, and their ground truth."""

    Ts_base_flange: np.ndarray
    Ts_camera_board: np.ndarray
    views: list[BoardView]
    T_flange_camera: np.ndarray
    T_base_board: np.ndarray

    @property
    def refine(self) -> Refinement:
        return Refinement(board=BOARD, camera=CAMERA, views=self.views)


def sample_T_camera_board(
    rng: np.random.Generator, *, distance_m: tuple[float, float] = (0.2, 0.35), tilt_deg: float = 35.0
) -> np.ndarray:
    """Return a random T_camera_board (4, 4) with all of the board in view."""
    azimuth, tilt = rng.uniform(0.0, 2.0 * np.pi), np.radians(tilt_deg) * np.sqrt(rng.uniform())
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    T = np.eye(4)
    T[:3, :3] = (lean * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-0.8, 0.8)])).as_matrix()
    z = rng.uniform(*distance_m)
    centre = np.array([*rng.uniform(-0.1, 0.1, 2) * z, z])
    T[:3, 3] = centre - T[:3, :3] @ (*(0.5 * np.array(BOARD.size_m)), 0.0)
    return T


def make_view(T_camera_board: np.ndarray, rng: np.random.Generator, corner_px: float, scale: float = 1.0) -> BoardView:
    """Return the view of a board at that pose, `scale` times as large as `BOARD`."""
    points = transform_points(T_camera_board, scale * BOARD.corners_m)
    pixels = CAMERA.project(points) + rng.normal(0.0, corner_px, (len(points), 2))
    inside = ((pixels > 5.0) & (pixels < np.array(CAMERA.size) - 5.0)).all(axis=1)
    return BoardView(ids=np.flatnonzero(inside), pixels_px=pixels[inside], sharpness=0.6, image_size=CAMERA.size)


def record(
    seed: int,
    n: int = 20,
    *,
    corner_px: float = 0.15,
    arm_m: float = 1e-4,
    arm_deg: float = 0.01,
    scale: float = 1.0,
    Ts_camera_board: np.ndarray | None = None,
    T_base_boards: np.ndarray | None = None,
) -> Recording:
    """Return an eye-in-hand capture of n samples.

    The true arm poses put the board at `Ts_camera_board`; the reported ones differ by the arm's scatter. The corners
    have noise. `T_base_boards` (n, 4, 4) is for a board that moves.
    """
    rng = np.random.default_rng(seed)
    wanted = np.array([sample_T_camera_board(rng) for _ in range(n)]) if Ts_camera_board is None else Ts_camera_board
    T_base_boards = np.repeat(T_BASE_BOARD[None], n, axis=0) if T_base_boards is None else T_base_boards
    true_arm = T_base_boards[0] @ inverse(wanted) @ inverse(T_FLANGE_CAMERA)
    reported = [apply_increment(T, rng.normal(0.0, np.repeat([arm_m, np.radians(arm_deg)], 3))) for T in true_arm]
    in_camera = inverse(true_arm @ T_FLANGE_CAMERA) @ T_base_boards
    views = [make_view(T, rng, corner_px, scale) for T in in_camera]
    return Recording(
        Ts_base_flange=np.array(reported),
        Ts_camera_board=np.array([estimate_board_pose(view, BOARD, CAMERA).T_camera_board for view in views]),
        views=views,
        T_flange_camera=T_FLANGE_CAMERA,
        T_base_board=T_base_boards[0],
    )


def corrupt(recording: Recording, index: int, step: np.ndarray) -> Recording:
    """Return the capture with the arm's pose of one sample changed by `step` (6,) [m, rad]."""
    arm = recording.Ts_base_flange.copy()
    arm[index] = apply_increment(arm[index], step)
    return replace(recording, Ts_base_flange=arm)


def photograph(
    T_camera_board: np.ndarray, board: Board = BOARD, *, camera: CameraModel = CAMERA, seed: int = 0
) -> np.ndarray:
    """Return an image (H, W, 3) of `board` on a grey table: rendered four times too large, averaged, with noise."""
    pixels, border, finer = 140, 70, 4
    texture = cv2.copyMakeBorder(board.image(pixels), *[border] * 4, cv2.BORDER_CONSTANT, value=255)
    step = board.square_m / pixels
    in_board = np.array([[step, 0.0, (0.5 - border) * step], [0.0, step, (0.5 - border) * step], [0.0, 0.0, 1.0]])
    finer_pixels = np.array([[finer, 0.0, (finer - 1) / 2], [0.0, finer, (finer - 1) / 2], [0.0, 0.0, 1.0]])
    plane = np.column_stack([T_camera_board[:3, :2], T_camera_board[:3, 3]])
    width, height = camera.size
    large = cv2.warpPerspective(
        texture, finer_pixels @ camera.matrix @ plane @ in_board, (width * finer, height * finer), borderValue=120
    )
    grey = 38.0 + 0.7 * cv2.resize(large, camera.size, interpolation=cv2.INTER_AREA)
    noisy = grey + np.random.default_rng(seed).normal(0.0, 1.5, grey.shape)
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)

"""Hand-eye in closed form: OpenCV's five methods, its two for robot-world and hand-eye, and a robust start."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from calibration.transforms import inverse, rotation_vectors

HAND_EYE = {
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
ROBOT_WORLD = {"shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}

_SUBSET = 5  # samples a guess is made from: few enough to be free of bad ones, enough to turn about two axes
_GUESSES = 60  # with 3 bad samples in 10 one guess in 12 is clean: all 60 are spoilt once in 200 times
_GOOD_SHARE = 0.4  # a guess is judged by this share of the samples, so the others may be bad or after a move


def all_closed_forms(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and T_mount_camera (4, 4) of each method that gives one; poses are (N, 4, 4).

    OpenCV 5.0 was released without these solvers; then there are none.
    """
    if not hasattr(cv2, "calibrateHandEye"):
        return
    arm, seen = _split(Ts_anchor_mount), _split(Ts_camera_board)
    arm_inverse = _split(inverse(Ts_anchor_mount))
    for name, method in HAND_EYE.items():
        try:
            found = cv2.calibrateHandEye(*arm, *seen, method=method)
        except cv2.error:
            continue  # a method that cannot cope with these poses says so this way
        yield from _proper(name, *found)
    for name, method in ROBOT_WORLD.items():
        try:
            _, _, R_camera_mount, p_camera_mount = cv2.calibrateRobotWorldHandEye(*seen, *arm_inverse, method=method)
        except cv2.error:
            continue
        yield from _proper(name, R_camera_mount.T, -R_camera_mount.T @ p_camera_mount)


def _split(Ts: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [T[:3, :3].copy() for T in Ts], [T[:3, 3:].copy() for T in Ts]


def _proper(name: str, R: np.ndarray, p: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the pose with the nearest rotation, unless it is not finite or turned inside out."""
    T = np.eye(4)
    if np.isfinite(R).all() and np.isfinite(p).all() and np.linalg.det(R) > 0.0:
        U, _, Vt = np.linalg.svd(R)
        T[:3, :3], T[:3, 3] = U @ Vt, np.ravel(p)
        yield name, T


def park_martin(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> np.ndarray:
    """Return T_mount_camera (4, 4) after Park and Martin (1994), from the motions between all pairs of samples."""
    first, second = np.triu_indices(len(Ts_anchor_mount), 1)
    A = inverse(Ts_anchor_mount[first]) @ Ts_anchor_mount[second]  # A X = X B
    B = Ts_camera_board[first] @ inverse(Ts_camera_board[second])
    alpha, beta = rotation_vectors(A[:, :3, :3]), rotation_vectors(B[:, :3, :3])
    U, _, Vt = np.linalg.svd(alpha.T @ beta)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    lever = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    offset = (B[:, :3, 3] @ T[:3, :3].T - A[:, :3, 3]).ravel()
    T[:3, 3] = np.linalg.lstsq(lever, offset, rcond=None)[0]
    return T


def robust_start(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return T_mount_camera and T_anchor_board (4, 4) that suit most samples, and how far off those are.

    Guesses are made from few samples each, the same ones every time; the one whose best samples agree best is taken.
    An error is in millimetres, a degree counting as five of them (what it does to a board 0.3 m away).
    """
    n = len(Ts_anchor_mount)
    rng = np.random.default_rng(0)
    subsets = [np.arange(n)] + [rng.choice(n, min(_SUBSET, n), replace=False) for _ in range(_GUESSES)]
    best: tuple[np.ndarray, np.ndarray, float] | None = None
    for subset in subsets:
        T_mount_camera = park_martin(Ts_anchor_mount[subset], Ts_camera_board[subset])
        boards = Ts_anchor_mount @ T_mount_camera @ Ts_camera_board
        for T_anchor_board in boards[subset]:
            error = np.quantile(_errors(boards, T_anchor_board), _GOOD_SHARE)
            if best is None or error < best[2]:
                best = T_mount_camera, T_anchor_board, float(error)
    assert best is not None
    return best


def _errors(boards: np.ndarray, T_anchor_board: np.ndarray) -> np.ndarray:
    cosine = 0.5 * (np.einsum("nij,ij->n", boards[:, :3, :3], T_anchor_board[:3, :3]) - 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return 1e3 * np.linalg.norm(boards[:, :3, 3] - T_anchor_board[:3, 3], axis=1) + 5.0 * angle

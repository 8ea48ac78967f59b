"""Closed forms of hand-eye calibration, and robust initial poses for the least squares.

The closed forms are OpenCV's five methods for AX = XB, its two for AX = ZB, and one of our own for subsets.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from hal.base.transforms import inverse, make_pose, rotation_vectors

HAND_EYE = {
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
ROBOT_WORLD = {"shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}

_SUBSET = 5  # samples of a hypothesis: few enough to be free of outliers, enough to turn about two axes
_HYPOTHESES = 60  # with 3 outliers in 10 samples one subset in 12 has none: all 60 have one once in 200 times
_INLIER_RATIO = 0.4  # a hypothesis is rated by this ratio of the samples: the others may be outliers or after a move
_MM_PER_DEG = 5.0  # what a degree does to a board 0.3 m from the camera


def solve_closed_forms(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and T_mount_camera (4, 4) of each method that has a solution; poses are (N, 4, 4).

    OpenCV 5.0 was released without these solvers; nothing is yielded there.
    """
    if not hasattr(cv2, "calibrateHandEye"):
        return
    arm, boards = _split(Ts_anchor_mount), _split(Ts_camera_board)
    arm_inverse = _split(inverse(Ts_anchor_mount))
    for name, method in HAND_EYE.items():
        try:
            found = cv2.calibrateHandEye(*arm, *boards, method=method)
        except cv2.error:
            continue  # how OpenCV reports that a method has no solution for these poses
        yield from _orthonormalize(name, *found)
    for name, method in ROBOT_WORLD.items():
        try:
            _, _, R_camera_mount, p_camera_mount = cv2.calibrateRobotWorldHandEye(*boards, *arm_inverse, method=method)
        except cv2.error:
            continue
        yield from _orthonormalize(name, R_camera_mount.T, -R_camera_mount.T @ p_camera_mount)


def _split(Ts: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [T[:3, :3].copy() for T in Ts], [T[:3, 3:].copy() for T in Ts]


def _orthonormalize(name: str, R: np.ndarray, p: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the pose with the nearest rotation, unless it is not finite or a reflection."""
    if np.isfinite(R).all() and np.isfinite(p).all() and np.linalg.det(R) > 0.0:
        U, _, Vt = np.linalg.svd(R)
        yield name, make_pose(U @ Vt, np.ravel(p))


def solve_park_martin(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> np.ndarray:
    """Return T_mount_camera (4, 4) after Park and Martin (1994), from the motions between all pairs of samples.

    OpenCV 5.0 was released without its own.
    """
    first, second = np.triu_indices(len(Ts_anchor_mount), 1)
    A = inverse(Ts_anchor_mount[first]) @ Ts_anchor_mount[second]  # A X = X B
    B = Ts_camera_board[first] @ inverse(Ts_camera_board[second])
    alpha, beta = rotation_vectors(A[:, :3, :3]), rotation_vectors(B[:, :3, :3])
    # Rotation by the Kabsch algorithm; the determinant excludes a reflection
    U, _, Vt = np.linalg.svd(alpha.T @ beta)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    # Position from (R_A − 1) p = R p_B − p_A of all pairs
    lever = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    offset = (B[:, :3, 3] @ T[:3, :3].T - A[:, :3, 3]).ravel()
    T[:3, 3] = np.linalg.lstsq(lever, offset, rcond=None)[0]
    return T


def estimate_initial_poses(
    Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return T_mount_camera and T_anchor_board (4, 4) that fit most samples, and the error of those samples [mm].

    A RANSAC with fixed subsets: the hypothesis with the lowest error over its best samples wins. The error adds the
    distance [mm] and the angle, a degree counted as `_MM_PER_DEG`.
    """
    n = len(Ts_anchor_mount)
    rng = np.random.default_rng(0)
    # All samples come first: without an outlier they are the best subset
    subsets = [np.arange(n)] + [rng.choice(n, min(_SUBSET, n), replace=False) for _ in range(_HYPOTHESES)]
    best: tuple[np.ndarray, np.ndarray, float] | None = None
    for subset in subsets:
        T_mount_camera = solve_park_martin(Ts_anchor_mount[subset], Ts_camera_board[subset])
        boards = Ts_anchor_mount @ T_mount_camera @ Ts_camera_board
        for T_anchor_board in boards[subset]:
            error = np.quantile(_errors(boards, T_anchor_board), _INLIER_RATIO)
            if best is None or error < best[2]:
                best = T_mount_camera, T_anchor_board, float(error)
    assert best is not None
    return best


def _errors(boards: np.ndarray, T_anchor_board: np.ndarray) -> np.ndarray:
    cosine = 0.5 * (np.einsum("nij,ij->n", boards[:, :3, :3], T_anchor_board[:3, :3]) - 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return 1e3 * np.linalg.norm(boards[:, :3, 3] - T_anchor_board[:3, 3], axis=1) + _MM_PER_DEG * angle

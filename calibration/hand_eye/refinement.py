"""Joint refinement of hand-eye transform, board pose and each sample's arm error by the reprojection error.

The arm's kinematics are not exact. Each sample's flange therefore has an error η = (ρ [m], ω [rad]) in its own axes,
with the scatter estimated from the samples as its prior. Without η an error of the arm would count as one of 35
independent corners, and the covariance would be far too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.board.board import Board
from calibration.board.detection import BoardView
from calibration.camera_model import CameraModel
from calibration.hand_eye.pose_fit import NoiseLevels, PoseData, PoseFit
from hal.base.transforms import apply_increment, inverse, skew, transform_points

_HUBER = 2.5  # standard deviations above which a corner's loss is linear instead of quadratic
_MIN_CORNER_NOISE_PX = 1e-4  # exact synthetic corners would make the weights infinite
_MIN_DEPTH_M = 1e-3
_ROUNDS = 2  # the Jacobian is exact at the start of each
_INITIAL_HUBER = 1.5  # the first round's, in medians of the residuals at its start


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refinement:
    """Inputs of the joint refinement in addition to the poses."""

    board: Board
    """The board seen."""
    camera: CameraModel
    """The camera, assumed exact."""
    views: Sequence[BoardView]
    """One view a sample, in the order of the poses."""


def estimate_corner_noise_px(refine: Refinement, Ts_camera_board: np.ndarray) -> float:
    """Return the standard deviation of a corner along one axis, from the fit of each view to its own pose [px]."""
    variances = []
    for view, T in zip(refine.views, Ts_camera_board, strict=True):
        points = transform_points(T, refine.board.corners_m[view.ids])
        square = np.sum((refine.camera.project(points) - view.pixels_px) ** 2)
        # Two equations a corner, less the six unknowns of the view's own pose
        variances.append(square / max(2 * len(view.ids) - 6, 1))
    # The median: one bad view shifts it only a little
    return max(float(np.sqrt(np.median(variances))), _MIN_CORNER_NOISE_PX)


def estimate_corner_covariances(refine: Refinement, Ts_camera_board: np.ndarray) -> np.ndarray:
    """Return the covariance (N, 6, 6) of each board pose in camera axes, from the noise of its corners."""
    sd = estimate_corner_noise_px(refine, Ts_camera_board)
    C = []
    for view, T in zip(refine.views, Ts_camera_board, strict=True):
        rotated = refine.board.corners_m[view.ids] @ T[:3, :3].T
        _, by_point = refine.camera.project_with_jacobian(rotated + T[:3, 3])
        J = np.concatenate([by_point, -by_point @ skew(rotated)], axis=2).reshape(-1, 6)
        C.append(sd**2 * np.linalg.inv(J.T @ J))
    return np.array(C)


def compute_reprojection_px(refine: Refinement, predicted: np.ndarray, scale: float) -> np.ndarray:
    """Return the rms distance (N,) between detected corners and those of boards at `predicted` (N, 4, 4) [px]."""
    rms = []
    for view, T in zip(refine.views, predicted, strict=True):
        points = transform_points(T, scale * refine.board.corners_m[view.ids])
        # A dropped sample may put the board behind the camera
        in_front = np.maximum(points, (-np.inf, -np.inf, _MIN_DEPTH_M))
        rms.append(np.sqrt(np.mean(np.sum((refine.camera.project(in_front) - view.pixels_px) ** 2, axis=1))))
    return np.array(rms)


def refine_jointly(
    refine: Refinement, data: PoseData, fit: PoseFit, noise: NoiseLevels, kept: np.ndarray
) -> tuple[PoseFit, np.ndarray]:
    """Return the refined fit and the covariance (6, 6) of the camera's ξ; the scale is kept."""
    bundle = _Bundle(refine, data, fit, noise, np.flatnonzero(kept))
    start = np.zeros(12 + 6 * len(bundle.samples))
    for k in range(_ROUNDS):
        # Where most corners are beyond the Huber limit the loss has hardly any curvature and the steps are tiny. The
        # first round therefore begins with a limit that most are within
        initial = _INITIAL_HUBER * float(np.median(np.abs(bundle.corner_residuals(start)))) if k == 0 else 0.0
        found = least_squares(
            bundle.residuals,
            start,
            jac=bundle.compute_jacobian,  # pyright: ignore[reportArgumentType] - SciPy's stub does not list functions
            loss="huber",
            f_scale=max(_HUBER, initial),
            x_scale=bundle.x_scale,
        )
        bundle.fit = bundle.apply_step(found.x)
    # SciPy has scaled the rows of `jac` by the weights of the loss
    H = found.jac.T @ found.jac
    return bundle.fit, np.linalg.inv(H)[:6, :6]


class _Bundle:
    """Residuals of all corners of the kept samples; the parameters are camera ξ, board ξ, η of each sample."""

    def __init__(
        self, refine: Refinement, data: PoseData, fit: PoseFit, noise: NoiseLevels, samples: np.ndarray
    ) -> None:
        self.fit = fit
        self.samples = samples
        # Expected size of the parameters: 1 mm and 1 mrad of the poses, a tenth of it of the arm's errors
        self.x_scale = np.concatenate(
            [np.repeat([1e-3, 1e-3] * 2, 3), np.tile(np.repeat([1e-4, 1e-4], 3), len(samples))]
        )
        self._data = data
        self._camera = refine.camera
        self._sd_px = estimate_corner_noise_px(refine, data.Ts_camera_board)
        self._arm = np.repeat([noise.arm_m, noise.arm_rad], 3)
        self._views = [refine.views[i] for i in samples]
        self._points = [fit.scale * refine.board.corners_m[view.ids] for view in self._views]

    def apply_step(self, x: np.ndarray) -> PoseFit:
        """Return the fit changed by the first twelve of the parameters `x`."""
        boards = np.stack([apply_increment(T, x[6:12]) for T in self.fit.Ts_anchor_board])
        return replace(self.fit, T_mount_camera=apply_increment(self.fit.T_mount_camera, x[:6]), Ts_anchor_board=boards)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return corner errors and η in standard deviations."""
        return np.concatenate([self.corner_residuals(x), (x[12:].reshape(-1, 6) / self._arm).ravel()])

    def corner_residuals(self, x: np.ndarray) -> np.ndarray:
        """Return the errors of all corners along both axes in standard deviations."""
        parts = []
        for view, (in_camera, _, _) in zip(self._views, self._camera_points(x), strict=True):
            parts.append((self._camera.project(in_camera) - view.pixels_px).ravel() / self._sd_px)
        return np.concatenate(parts)

    def compute_jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the derivatives of `residuals`."""
        n_corners = 2 * sum(len(points) for points in self._points)
        J = np.zeros((n_corners + len(x) - 12, len(x)))
        row = 0
        for k, (in_camera, by_board, by_arm) in enumerate(self._camera_points(x)):
            _, by_point = self._camera.project_with_jacobian(in_camera)
            by_point = by_point / self._sd_px  # (n, 2, 3)
            rows = slice(row, row + 2 * len(in_camera))
            by_camera = np.concatenate([np.broadcast_to(-np.eye(3), (len(in_camera), 3, 3)), skew(in_camera)], axis=2)
            J[rows, :6] = (by_point @ by_camera).reshape(-1, 6)
            J[rows, 6:12] = (by_point @ by_board).reshape(-1, 6)
            J[rows, 12 + 6 * k : 18 + 6 * k] = (by_point @ by_arm).reshape(-1, 6)
            row = rows.stop
        J[row:, 12:] = np.diag(np.tile(1.0 / self._arm, len(self.samples)))
        return J

    def _camera_points(self, x: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return for each sample the corners in the camera (n, 3), and their Jacobians (n, 3, 6) by ξ and η."""
        fit, found = self.apply_step(x), []
        T_camera_mount = inverse(fit.T_mount_camera)
        for k, i in enumerate(self.samples):
            T_anchor_board, points = fit.Ts_anchor_board[fit.board_index[i]], self._points[k]
            shift, turn = x[12 + 6 * k : 15 + 6 * k], Rotation.from_rotvec(x[15 + 6 * k : 18 + 6 * k]).as_matrix()
            T_mount_anchor = inverse(self._data.Ts_anchor_mount[i])
            anchor_points = transform_points(T_anchor_board, points)
            if self._data.camera_on_flange:  # the flange is the mount
                at_flange = (transform_points(T_mount_anchor, anchor_points) - shift) @ turn
                in_mount, R_camera_flange, sign = at_flange, T_camera_mount[:3, :3], -1.0
            else:  # the flange is the anchor
                at_flange = anchor_points @ turn.T + shift
                in_mount = transform_points(T_mount_anchor, at_flange)
                R_camera_flange, sign = T_camera_mount[:3, :3] @ T_mount_anchor[:3, :3], 1.0
            in_camera = transform_points(T_camera_mount, in_mount)
            R_camera_board = T_camera_mount[:3, :3] @ T_mount_anchor[:3, :3] @ T_anchor_board[:3, :3]
            found.append(
                (
                    in_camera,
                    _motion_jacobian(R_camera_board, points, 1.0),
                    _motion_jacobian(R_camera_flange, at_flange, sign),
                )
            )
        return found


def _motion_jacobian(R: np.ndarray, points: np.ndarray, sign: float) -> np.ndarray:
    """Return the Jacobian (n, 3, 6) of `points` (n, 3) by a motion ξ of their frame, in the axes R rotates into."""
    shift = np.broadcast_to(R, (len(points), 3, 3))
    return sign * np.concatenate([shift, -R @ skew(points)], axis=2)

"""Result of a hand-eye calibration, with its residuals and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.errors import CalibrationError, CalibrationWarning
from calibration.hand_eye.pose_fit import NoiseLevels

Setup = Literal["eye_in_hand", "eye_to_hand"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MethodResult:
    """Result of one closed-form method."""

    name: str
    """tsai, park, horaud, andreff, daniilidis; shah, li (robot-world/hand-eye)."""
    T_mount_camera: np.ndarray
    """(4, 4) camera pose."""
    T_anchor_board: np.ndarray
    """(4, 4) mean of the board poses over the samples."""
    rms_mm: float
    """Spread of the board's position over all samples [mm]."""
    rms_deg: float
    """Spread of the board's orientation over all samples [°]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HandEyeResult:
    """The camera's pose, its uncertainty, and the residuals of the samples."""

    setup: Setup
    """The problem that was solved."""
    T_mount_camera: np.ndarray
    """(4, 4) the camera on the flange (eye in hand) or in the base (eye to hand)."""
    T_anchor_board: np.ndarray
    """(4, 4) the board in the base (eye in hand) or on the flange (eye to hand)."""
    covariance: np.ndarray
    """(6, 6) of ξ = (ρ [m], ω [rad]) in camera axes: the true camera has the position p + R ρ and the rotation
    R Exp(ω), where p and R are those of `T_mount_camera`."""
    uncertainty_mm: float
    """Radius around the position that holds the true one with probability `uncertainty.COVERAGE` [mm]."""
    uncertainty_deg: float
    """Angle from the orientation within which the true one is with probability `uncertainty.COVERAGE` [°]."""
    methods: tuple[MethodResult, ...]
    """The closed forms, best first."""
    sample_names: tuple[str, ...]
    """(N,) names of all samples given."""
    residuals_mm: np.ndarray
    """(N,) distance of each sample's board from `T_anchor_board`, dropped ones included [mm]."""
    residuals_deg: np.ndarray
    """(N,) the same in orientation [°]."""
    residuals_px: np.ndarray | None
    """(N,) rms reprojection error of each sample through arm and hand-eye; None without `refine` [px]."""
    initial_px: np.ndarray | None
    """(N,) the same with the best closed form, before the refinement [px]."""
    rms_mm: float
    """Root mean square of `residuals_mm` over the samples kept [mm]."""
    rms_deg: float
    """The same of `residuals_deg` [°]."""
    rms_px: float | None
    """Root mean square reprojection error over the corners of the samples kept [px]."""
    holdout_mm: float
    """rms error of each kept sample under the solution of all others [mm]."""
    holdout_deg: float
    """The same in orientation [°]."""
    diversity: float
    """Score of the rotations, 0 (undetermined) … 1 (good), by `diversity.compute_diversity`."""
    square_m: float | None
    """The edge of a square as the arm's motions measure it; None without `refine` [m]."""
    noise: NoiseLevels
    """Scatter of the arm, estimated from the samples; without `refine` including that of the board's poses."""
    dropped: dict[str, str]
    """Samples left out by name, with the reason."""
    warnings: tuple[CalibrationWarning, ...]
    """`too_few_poses`, `too_similar_poses`, `outliers`, `board_moved`, `wrong_square_size`, …"""

    @property
    def T_flange_camera(self) -> np.ndarray:
        """(4, 4) the camera on the flange.

        Raises:
            CalibrationError: `wrong_setup`: an eye-to-hand result.
        """
        return self._pose_of("eye_in_hand", self.T_mount_camera)

    @property
    def T_base_board(self) -> np.ndarray:
        """(4, 4) the board in the base; raises as `T_flange_camera` does."""
        return self._pose_of("eye_in_hand", self.T_anchor_board)

    @property
    def T_base_camera(self) -> np.ndarray:
        """(4, 4) the camera in the base.

        Raises:
            CalibrationError: `wrong_setup`: an eye-in-hand result.
        """
        return self._pose_of("eye_to_hand", self.T_mount_camera)

    @property
    def T_flange_board(self) -> np.ndarray:
        """(4, 4) the board on the flange; raises as `T_base_camera` does."""
        return self._pose_of("eye_to_hand", self.T_anchor_board)

    def _pose_of(self, setup: Setup, T: np.ndarray) -> np.ndarray:
        if self.setup != setup:
            raise CalibrationError(f"hand-eye result: wrong setup ({self.setup}, needed {setup}).", code="wrong_setup")
        return T

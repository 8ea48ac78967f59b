"""What a hand-eye calibration finds, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibration.errors import CalibrationError, CalibrationWarning
from calibration.hand_eye.pose_fit import NoiseLevels

Setup = Literal["eye_in_hand", "eye_to_hand"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MethodResult:
    """What one closed-form method says."""

    name: str
    """tsai, park, horaud, andreff, daniilidis; shah, li (robot-world/hand-eye)."""
    T_mount_camera: np.ndarray
    """(4, 4) its camera pose."""
    T_anchor_board: np.ndarray
    """(4, 4) the mean of where the samples then see the board."""
    rms_mm: float
    """Spread of the board's position over all samples [mm]."""
    rms_deg: float
    """Spread of the board's orientation over all samples [°]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HandEyeResult:
    """The camera's pose, and how far to trust it."""

    setup: Setup
    """Which of the two problems was solved."""
    T_mount_camera: np.ndarray
    """(4, 4) the camera on the flange (eye in hand) or in the base (eye to hand)."""
    T_anchor_board: np.ndarray
    """(4, 4) the board in the base (eye in hand) or on the flange (eye to hand)."""
    covariance: np.ndarray
    """(6, 6) of ξ = (ρ [m], ω [rad]) in camera axes: the true camera has the position p + R ρ and the rotation
    R Exp(ω), where p and R are those of `T_mount_camera`."""
    uncertainty_mm: float
    """The camera's true position is nearer than this with probability `uncertainty.COVERAGE` [mm]."""
    uncertainty_deg: float
    """The camera's true orientation is nearer than this with probability `uncertainty.COVERAGE` [°]."""
    methods: tuple[MethodResult, ...]
    """The closed forms, best first."""
    sample_names: tuple[str, ...]
    """(N,) names of all samples given."""
    residuals_mm: np.ndarray
    """(N,) how far each sample sees the board from `T_anchor_board`, dropped ones included [mm]."""
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
    """Spread of the rotations, 0 (nothing can be said) … 1 (as good as it gets)."""
    square_m: float | None
    """The edge of a square as the arm's motions measure it; None without `refine` [m]."""
    noise: NoiseLevels
    """The scatter of the arm that the samples show; without `refine` that of the board's poses too."""
    dropped: dict[str, str]
    """Samples left out by name, with the reason."""
    warnings: tuple[CalibrationWarning, ...]
    """`too_few_poses`, `too_similar_poses`, `outliers`, `board_moved`, `wrong_square_size`, …"""

    @property
    def T_flange_camera(self) -> np.ndarray:
        """(4, 4) the camera on the flange.

        Raises:
            CalibrationError: this is an eye to hand.
        """
        return self._of("eye_in_hand", self.T_mount_camera)

    @property
    def T_base_board(self) -> np.ndarray:
        """(4, 4) the board in the base; raises as `T_flange_camera` does."""
        return self._of("eye_in_hand", self.T_anchor_board)

    @property
    def T_base_camera(self) -> np.ndarray:
        """(4, 4) the camera in the base.

        Raises:
            CalibrationError: this is an eye in hand.
        """
        return self._of("eye_to_hand", self.T_mount_camera)

    @property
    def T_flange_board(self) -> np.ndarray:
        """(4, 4) the board on the flange; raises as `T_base_camera` does."""
        return self._of("eye_to_hand", self.T_anchor_board)

    def _of(self, setup: Setup, T: np.ndarray) -> np.ndarray:
        if self.setup != setup:
            raise CalibrationError("wrong_setup", f"this calibration is of an {self.setup}, not of an {setup}.")
        return T

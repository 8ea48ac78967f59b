"""Coverage of the image and of the rotations by the samples of a capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from z1_runtime.calibration_session.capture import CapturedView

# Square cells: the D405's 640 × 480 pixels in tiles of 80
_ROWS, _COLUMNS = 6, 8
_SHADES = " ░▒▓█"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Coverage:
    """Coverage by all samples so far."""

    corners: np.ndarray
    """(6, 8) detected corners per cell of the image."""
    rotation_spread_deg: np.ndarray
    """(3,) spread of the camera's orientations about its three principal axes, descending: twice the root mean square
    of the rotations from their mean [°]."""

    @classmethod
    def of(cls, views: Sequence[CapturedView]) -> Coverage:
        """Return the coverage by the valid ones of `views`."""
        corners = np.zeros((_ROWS, _COLUMNS), int)
        valid = [sample for sample in views if sample.view is not None]
        for sample in valid:
            assert sample.view is not None
            width, height = sample.view.image_size
            # Whole numbers are the centres of pixels in OpenCV, so the image begins at −0.5
            column, row = (sample.view.pixels_px.T + 0.5) * [[_COLUMNS / width], [_ROWS / height]]
            # `+=` would count a cell once, however many corners share it
            np.add.at(corners, (row.astype(int).clip(0, _ROWS - 1), column.astype(int).clip(0, _COLUMNS - 1)), 1)
        return cls(
            corners=corners,
            rotation_spread_deg=_rotation_spread_deg([sample.T_base_camera[:3, :3] for sample in valid]),
        )

    def summary(self) -> str:
        """Return the coverage in one line."""
        a, b, c = self.rotation_spread_deg
        return f"{(self.corners > 0).mean():.0%} of the image, rotations {a:.0f}° × {b:.0f}° × {c:.0f}°"

    def draw_map(self) -> str:
        """Return the image's cells as shaded blocks, darker for fewer corners."""
        full = max(int(self.corners.max()), 1)
        shade = np.ceil(self.corners / full * (len(_SHADES) - 1)).astype(int)
        rows = ["  │" + "".join(2 * _SHADES[cell] for cell in row) + "│" for row in shade]
        edge = "─" * (2 * _COLUMNS)
        return "\n".join([f"  ┌{edge}┐", *rows, f"  └{edge}┘", f"  {self.summary()}"])


def _rotation_spread_deg(rotations: Sequence[np.ndarray]) -> np.ndarray:
    if len(rotations) < 2:
        return np.zeros(3)
    orientations = Rotation.from_matrix(np.array(rotations))
    rotations_rad = (orientations.mean().inv() * orientations).as_rotvec()
    # Rounding can leave an eigenvalue just below 0, which has no root
    return 2.0 * np.rad2deg(
        np.sqrt(np.maximum(np.linalg.eigvalsh(rotations_rad.T @ rotations_rad / len(rotations_rad))[::-1], 0.0))
    )

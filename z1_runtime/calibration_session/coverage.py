"""How much of the picture and of the rotations the samples taken so far cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from z1_runtime.calibration_session.capture import Taken

_ROWS, _COLUMNS = 6, 8
_SHADES = " ░▒▓█"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Coverage:
    """Of all samples so far."""

    corners: np.ndarray
    """(6, 8) corners seen per cell of the picture."""
    turns_deg: np.ndarray
    """(3,) spread of the camera's orientations about its three main axes, largest first: twice the root mean square
    of the turns from their mean [°]."""

    @classmethod
    def of(cls, taken: Sequence[Taken]) -> Coverage:
        """Return what the usable ones among `taken` cover."""
        corners = np.zeros((_ROWS, _COLUMNS), int)
        seen = [sample for sample in taken if sample.view is not None]
        for sample in seen:
            assert sample.view is not None
            width, height = sample.view.image_size
            column, row = (sample.view.pixels_px.T + 0.5) * [[_COLUMNS / width], [_ROWS / height]]
            np.add.at(corners, (row.astype(int).clip(0, _ROWS - 1), column.astype(int).clip(0, _COLUMNS - 1)), 1)
        return cls(corners=corners, turns_deg=_spread_of_turns([sample.T_base_camera[:3, :3] for sample in seen]))

    def summary(self) -> str:
        """Return one line."""
        a, b, c = self.turns_deg
        return f"{(self.corners > 0).mean():.0%} of the picture, turns {a:.0f}° × {b:.0f}° × {c:.0f}°"

    def picture(self) -> str:
        """Return the picture's cells as shaded blocks, darker where fewer corners were seen."""
        full = max(int(self.corners.max()), 1)
        shade = np.ceil(self.corners / full * (len(_SHADES) - 1)).astype(int)
        rows = ["  │" + "".join(2 * _SHADES[cell] for cell in row) + "│" for row in shade]
        edge = "─" * (2 * _COLUMNS)
        return "\n".join([f"  ┌{edge}┐", *rows, f"  └{edge}┘", f"  {self.summary()}"])


def _spread_of_turns(rotations: Sequence[np.ndarray]) -> np.ndarray:
    if len(rotations) < 2:
        return np.zeros(3)
    all_ = Rotation.from_matrix(np.array(rotations))
    turns = (all_.mean().inv() * all_).as_rotvec()
    return 2.0 * np.rad2deg(np.sqrt(np.maximum(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1], 0.0)))

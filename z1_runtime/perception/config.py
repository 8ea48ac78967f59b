"""Limits of perception; the paper's values where it gives one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hal.base.errors import InvalidValueError
from z1_runtime.perception.extrinsics_check import ExtrinsicsCheck
from z1_runtime.perception.self_filter import SelfFilter
from z1_runtime.perception.table_plane import TableConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class PerceptionConfig:
    """Limits of the clouds; the paper's values where it gives one."""

    crop: Literal["mask", "box"] = "mask"
    """Crop of the depth image: the detection's mask where it has one, or always its box, as in the paper."""
    d_max_m: float = 1.0
    """Maximum depth [m] (paper)."""
    clip_percent: tuple[float, float] = (1.0, 99.0)
    """Depth percentiles kept inside the crop [%] (paper)."""
    statistical_k: int = 20
    """Neighbours of the statistical filter (paper)."""
    statistical_n_sigma: float = 2.0
    """Threshold of the statistical filter, in standard deviations above the mean (paper)."""
    radius_m: float = 0.010
    """Radius of the radius filter [m] (paper)."""
    radius_min_neighbours: int = 10
    """Minimum number of neighbours within that radius (paper)."""
    min_height_m: float = 0.005
    """Minimum height of the object's points above the table [m]; larger where the depth noise is larger."""
    voxel_m: float = 0.002
    """Voxel size of the object's cloud [m]; 0 = no voxels."""
    rim_px: int = 3
    """Width of the rim around the crop that is neither object nor scene [px]: masks are seldom exact."""
    filter_points: int = 6000
    """Maximum number of points given to the two neighbour filters, evenly chosen: bounds their time."""
    max_points: int = 5000
    """Maximum size of the object's cloud."""
    min_points: int = 100
    """Minimum size of the object's cloud."""
    table: TableConfig = field(default_factory=TableConfig)
    """Search for the table plane."""
    self_filter: SelfFilter = field(default_factory=SelfFilter)
    """Removal of the robot's own gripper from the frame."""
    extrinsics_check: ExtrinsicsCheck = field(default_factory=ExtrinsicsCheck)
    """Correction of the extrinsics by the jaws in the picture."""

    def __post_init__(self) -> None:
        if self.crop not in ("mask", "box"):
            raise InvalidValueError(f"crop is {self.crop!r}; allowed is mask or box.", code="crop")
        low, high = self.clip_percent
        if not 0.0 <= low < high <= 100.0:
            raise InvalidValueError(
                f"clip_percent is {self.clip_percent}; it must be (low, high) with 0 <= low < high <= 100.",
                code="clip_percent",
            )
        for name in ("d_max_m", "statistical_n_sigma", "radius_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be positive and finite.", code=name)
        for name in ("statistical_k", "radius_min_neighbours", "filter_points", "max_points", "min_points"):
            if getattr(self, name) < 1:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be 1 or more.", code=name)
        for name in ("min_height_m", "voxel_m", "rim_px"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(
                    f"{name} is {getattr(self, name)}; it must be finite and not negative.", code=name
                )

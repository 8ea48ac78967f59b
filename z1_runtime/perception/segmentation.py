"""From one aligned RGB-D frame to the object's cloud, the scene's cloud and the table: the paper's perception."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame
from models.detector.detector import best_of, labels_for
from models.types import Detection
from z1_runtime.perception.detector import Detector, NoDepthError, NoDetectionError, SmallCloudError
from z1_runtime.perception.extrinsics import ExtrinsicsCheck
from z1_runtime.perception.point_cloud import (
    back_project,
    box_pixels,
    continuous_pixels,
    depth_clip,
    radius_inliers,
    statistical_inliers,
    subsample,
    valid_pixels,
    voxel_downsample,
)
from z1_runtime.perception.self_filter import SelfFilter, mask_depth, occluded_points
from z1_runtime.perception.table_plane import TableConfig, expected_table, fit_table
from z1_runtime.types import Observation


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


_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilteredFrame:
    """A frame, the same without the robot's own gripper, and the extrinsics it was taken with."""

    raw: RgbdFrame
    """As the camera gave it."""
    masked: RgbdFrame
    """The same; the depth is 0 where it may show the robot's own gripper."""
    T_flange_camera: np.ndarray
    """(4, 4) extrinsics: as given, or as the jaws in the picture show them where that differs."""


class Perception:
    """Stages from a frame to an observation: `filter_self`, `detect`, `segment`; `observe` is all three.

    Args:
        config: limits of the clouds.
        detector: finds the object.
        T_flange_camera: (4, 4) extrinsics as they are known.
    """

    def __init__(
        self, config: PerceptionConfig, detector: Detector, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA
    ) -> None:
        self._config = config
        self._detector = detector
        self._T_flange_camera = T_flange_camera
        self._correction_logged = False

    @property
    def detector(self) -> Detector:
        """The detector that finds the object."""
        return self._detector

    def observe(self, frame: RgbdFrame, T_base_flange: np.ndarray, jaw: float, label: str | None = None) -> Observation:
        """Return the observation of one frame; arguments and errors as in the three stages."""
        filtered = self.filter_self(frame, jaw)
        T_base_camera = T_base_flange @ filtered.T_flange_camera
        return self.segment(filtered, T_base_camera, self.detect(filtered, T_base_camera, label))

    def filter_self(self, frame: RgbdFrame, jaw: float) -> FilteredFrame:
        """Return `frame` without the robot's own gripper, and the extrinsics checked against its jaws.

        Args:
            frame: the image.
            jaw: jaw angle when it was taken [rad].
        """
        config, T_flange_camera = self._config, self._T_flange_camera
        gripper = config.self_filter.gripper_pixels(frame, jaw, T_flange_camera)
        estimate = config.extrinsics_check.correct(frame, gripper, jaw, T_flange_camera)
        if estimate is not None:
            T_flange_camera = estimate.T_flange_camera
            # Once: each frame would repeat it
            if not self._correction_logged:
                self._correction_logged = True
                _LOG.warning(
                    "the jaws in the picture show the camera off its extrinsics by %.1f mm at 0.4 m. Each frame is "
                    "corrected; calibrate the camera with `./z1 calibrate hand-eye`.",
                    1e3 * estimate.correction_m,
                )
        return FilteredFrame(raw=frame, masked=mask_depth(frame, gripper), T_flange_camera=T_flange_camera)

    def detect(self, filtered: FilteredFrame, T_base_camera: np.ndarray, label: str | None = None) -> Detection:
        """Return the most confident detection.

        Args:
            filtered: the image without the robot.
            T_base_camera: (4, 4) camera pose when it was taken.
            label: the wanted class; ignored by a detector without classes.

        Raises:
            NoDepthError: no depth pixel was measured.
            NoDetectionError: nothing (of that class) was found.
            InvalidValueError: the detector has classes, and `label` is none of them.
        """
        _require_depth(filtered.masked)
        detector = self._detector
        found = detector.detect(filtered.masked, T_base_camera)
        confident = [d for d in found if d.confidence > detector.min_confidence]
        labels = [d.label for d in confident]
        if label is not None and detector.classes:
            labels = labels_for(label, detector.classes)
        best = best_of(confident, labels)
        if best is None:
            raise NoDetectionError(
                f"{type(detector).__name__} found no {label or 'object'}{_list_found(found, detector.min_confidence)}. "
                "Put the object 0.40 to 0.56 m in front of the arm, in view of the wrist camera, and try again."
            )
        return best

    def segment(self, filtered: FilteredFrame, T_base_camera: np.ndarray, detection: Detection) -> Observation:
        """Return the clouds and the table for one detection.

        The object: crop by mask (or box) → 0 < d ≤ d_max → depth percentiles → table removed → flying pixels, then
        statistical and radius outliers removed → voxels. The scene is every other measured point at full resolution,
        without flying pixels and the robot's own gripper. Points that the filters removed from the object are in
        neither: they surround the object and would make every grasp collide.

        Raises:
            NoDepthError: no depth pixel was measured.
            NoTableError: the table is not in view.
            SmallCloudError: too little is left of the object; the message counts each stage.
        """
        frame = filtered.masked
        _require_depth(frame)
        config, depth = self._config, frame.depth_m
        crop = detection.mask if config.crop == "mask" else None
        if crop is None:
            crop = box_pixels(depth.shape, detection.box_px)
        rim = cv2.dilate(crop.astype(np.uint8), np.ones((2 * config.rim_px + 1,) * 2, np.uint8)).astype(bool)
        continuous = continuous_pixels(depth)
        # Flying pixels stay inside the crop: the paper takes the depth percentiles of all of it
        used = valid_pixels(depth, config.d_max_m) & (continuous | crop)
        points = back_project(depth, frame.intrinsics, used)
        table = fit_table(points, expected_table(T_base_camera), config.table)
        above = table.above(points, config.min_height_m)

        candidate = crop[used]
        solid = np.zeros(depth.shape, bool)
        solid[used] = candidate & above & continuous[used]
        object_points = self._clean(points[candidate], above[candidate], continuous[used][candidate])
        return Observation(
            frame=filtered.raw,
            T_base_camera=T_base_camera,
            detection=detection,
            object_points=object_points,
            # The table under a box-shaped crop is scene; points above it inside the crop are not.
            scene_points=points[continuous[used] & ~(rim[used] & above)],
            table=table.plane,
            occluded_points=occluded_points(depth, frame.intrinsics, solid),
        )

    def _clean(self, points: np.ndarray, above: np.ndarray, continuous: np.ndarray) -> np.ndarray:
        """Return the object among the points of a crop, given those above the table and those of continuous depth."""
        config = self._config
        counts = {"crop": len(points)}
        # As in the paper, before the table is removed
        keep = depth_clip(points, *config.clip_percent)
        counts["depth clip"] = int(keep.sum())
        keep &= above
        counts["table removed"] = int(keep.sum())
        points = points[keep & continuous]
        counts["flying pixels removed"] = len(points)
        points = points[subsample(points, config.filter_points)]
        points = points[statistical_inliers(points, config.statistical_k, config.statistical_n_sigma)]
        counts["statistical"] = len(points)
        points = points[radius_inliers(points, config.radius_m, config.radius_min_neighbours)]
        counts["radius"] = len(points)
        if config.voxel_m > 0:
            points = voxel_downsample(points, config.voxel_m)
            counts["voxel"] = len(points)
        if len(points) < config.min_points:
            stages = ", ".join(f"{stage} {n}" for stage, n in counts.items())
            raise SmallCloudError(
                f"only {len(points)} points of the object are left, {config.min_points} are needed (points after each "
                f"stage: {stages}). Move the object closer, or turn it."
            )
        return points[subsample(points, config.max_points)]


def _list_found(found: list[Detection], min_confidence: float) -> str:
    """Return the end of a sentence that names the detections that do not count."""
    if not found:
        return ""
    best = sorted(found, key=lambda d: -d.confidence)[:5]
    listed = ", ".join(f"{d.label} {d.confidence:.2f}" for d in best)
    return f"; it found {listed} (confidence, required is above {min_confidence:g})"


def _require_depth(frame: RgbdFrame) -> None:
    if not (frame.depth_m > 0).any():
        raise NoDepthError(
            "the depth image holds no measurement (all zero); check that the lens is free, that it is light enough and "
            "that the object is more than 0.07 m away."
        )

"""From one aligned RGB-D frame to the object's cloud, the scene's cloud and the table: the paper's perception."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame
from models.detector.detector import best_of, labels_for
from models.types import Detection
from z1_runtime.perception.detectors import Detector
from z1_runtime.perception.extrinsics_check import ExtrinsicsCheck
from z1_runtime.perception.occlusion import occluded_points
from z1_runtime.perception.point_cloud import (
    PerceptionError,
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
from z1_runtime.perception.self_filter import SelfFilter
from z1_runtime.perception.table_plane import TableConfig, expected_table, fit_table
from z1_runtime.types import Observation


class NoDepthError(PerceptionError):
    """The depth image is empty."""


class NoDetectionError(PerceptionError):
    """The detector found nothing (of the wanted class)."""


class SmallCloudError(PerceptionError):
    """Too few points of the object are left after filtering."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PerceptionConfig:
    """Limits of the clouds; the paper's values where it gives one."""

    crop: Literal["mask", "box"] = "mask"
    """What is cut out of the depth: the detection's mask where it has one, or always its box, as in the paper."""
    d_max_m: float = 1.0
    """Depth beyond this is dropped [m]."""
    clip_percent: tuple[float, float] = (1.0, 99.0)
    """Depth percentiles kept inside the crop [%]."""
    statistical_k: int = 20
    """Neighbours of the statistical filter."""
    statistical_n_sigma: float = 2.0
    """Its threshold, in standard deviations above the mean."""
    radius_m: float = 0.010
    """Radius of the radius filter [m]."""
    radius_min_neighbours: int = 10
    """Neighbours it wants within that radius."""
    min_height_m: float = 0.005
    """Points of the crop lower than this above the table are table [m]; more where the depth noise is more."""
    voxel_m: float = 0.002
    """Voxel of the object's cloud [m]; 0 = none."""
    rim_px: int = 3
    """What stands this close around the crop is neither object nor scene [px]: masks are seldom exact."""
    filter_points: int = 6000
    """Most points the two neighbour filters are given, evenly chosen: bounds their time to about 20 ms."""
    max_points: int = 5000
    """Most points of the object's cloud."""
    min_points: int = 100
    """Fewest points of the object's cloud."""
    table: TableConfig = field(default_factory=TableConfig)
    own: SelfFilter = field(default_factory=SelfFilter)
    mount: ExtrinsicsCheck = field(default_factory=ExtrinsicsCheck)
    """Whether the jaws in the picture may correct where the camera sits."""

    def __post_init__(self) -> None:
        if self.crop not in ("mask", "box"):
            raise InvalidValueError(f"crop is {self.crop!r}; allowed is mask or box.")
        low, high = self.clip_percent
        if not 0.0 <= low < high <= 100.0:
            raise InvalidValueError(
                f"clip_percent is {self.clip_percent}; it must be (low, high) with 0 <= low < high <= 100."
            )
        for name in ("d_max_m", "statistical_n_sigma", "radius_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be positive and finite.")
        for name in ("statistical_k", "radius_min_neighbours", "filter_points", "max_points", "min_points"):
            if getattr(self, name) < 1:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be 1 or more.")
        for name in ("min_height_m", "voxel_m", "rim_px"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be finite and not negative.")


class Perception:
    """Detects one object and cuts the clouds; `observe` is `detect` and then `segment`.

    Args:
        config: limits of the clouds.
        detector: says where the object is.
        T_flange_camera: (4, 4) hand-eye transform, by which the robot's own gripper is found in the picture.
    """

    def __init__(
        self, config: PerceptionConfig, detector: Detector, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA
    ) -> None:
        self._config = config
        self._detector = detector
        self._T_flange_camera = T_flange_camera

    @property
    def detector(self) -> Detector:
        """Who says where the object is."""
        return self._detector

    def observe(self, frame: RgbdFrame, T_base_camera: np.ndarray, jaw: float, label: str | None = None) -> Observation:
        """Return what is seen; arguments and errors as in `detect` and `segment`."""
        return self.segment(frame, T_base_camera, jaw, self.detect(frame, T_base_camera, jaw, label))

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray, jaw: float, label: str | None = None) -> Detection:
        """Return the most confident detection.

        Args:
            frame: the image.
            T_base_camera: (4, 4) camera pose when it was taken.
            jaw: mover angle when it was taken; the robot's own gripper is left out [rad].
            label: the wanted class; ignored by a detector that knows no classes.

        Raises:
            NoDepthError: no depth pixel was measured.
            NoDetectionError: nothing (of that class) was found.
            ValueError: the detector knows classes, and that is none of them.
        """
        _require_depth(frame)
        detector = self._detector
        found = detector.detect(self._without_gripper(frame, jaw), T_base_camera)
        sure = [d for d in found if d.confidence > detector.min_confidence]
        labels = [d.label for d in sure]
        if label is not None and detector.classes:
            labels = labels_for(label, detector.classes)
        best = best_of(sure, labels)
        if best is None:
            instead = _seen_instead(found, detector.min_confidence)
            raise NoDetectionError(
                f"{type(detector).__name__} found no {label or 'object'}{instead}. "
                "Put the object 0.40 to 0.56 m in front of the arm, in view of the wrist camera, and look again."
            )
        return best

    def segment(self, frame: RgbdFrame, T_base_camera: np.ndarray, jaw: float, detection: Detection) -> Observation:
        """Return the clouds and the table for one detection.

        The object: crop by mask (or box) → 0 < d ≤ d_max → depth percentiles → table taken off → flying pixels, then
        statistical and radius outliers dropped → voxels. The scene is every other measured point at full resolution,
        without flying pixels and the robot's own gripper. What the filters dropped from the object is in neither: it
        hangs around the object and would make every grasp collide.

        Raises:
            NoDepthError: no depth pixel was measured.
            NoTableError: the table is not in view.
            SmallCloudError: too little is left of the object; the message counts each stage.
        """
        _require_depth(frame)
        config, depth = self._config, self._without_gripper(frame, jaw).depth_m
        crop = detection.mask if config.crop == "mask" else None
        if crop is None:
            crop = box_pixels(depth.shape, detection.box_px)
        rim = cv2.dilate(crop.astype(np.uint8), np.ones((2 * config.rim_px + 1,) * 2, np.uint8)).astype(bool)
        continuous = continuous_pixels(depth)
        seen = valid_pixels(depth, config.d_max_m) & (continuous | crop)
        points = back_project(depth, frame.intrinsics, seen)
        table = fit_table(points, expected_table(T_base_camera), config.table)
        above = table.above(points, config.min_height_m)

        candidate = crop[seen]
        solid = np.zeros(depth.shape, bool)
        solid[seen] = candidate & above & continuous[seen]
        object_points = self._clean(points[candidate], above[candidate], continuous[seen][candidate])
        return Observation(
            frame=frame,
            T_base_camera=T_base_camera,
            detection=detection,
            object_points=object_points,
            # The table under a box-shaped crop is scene; what stands inside the crop is not.
            scene_points=points[continuous[seen] & ~(rim[seen] & above)],
            table=table.plane,
            occluded_points=occluded_points(depth, frame.intrinsics, solid),
        )

    def _without_gripper(self, frame: RgbdFrame, jaw: float) -> RgbdFrame:
        return self._config.own.mask_gripper(frame, jaw, self._T_flange_camera)

    def _clean(self, points: np.ndarray, above: np.ndarray, continuous: np.ndarray) -> np.ndarray:
        """Return the object among the points of a crop, given which are above the table and which do not fly."""
        config = self._config
        counts = {"crop": len(points)}
        keep = depth_clip(points, *config.clip_percent)
        counts["depth clip"] = int(keep.sum())
        keep &= above
        counts["table off"] = int(keep.sum())
        points = points[keep & continuous]
        counts["flying off"] = len(points)
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
                f"stage: {stages}). Move the object closer, or look at it from another side."
            )
        return points[subsample(points, config.max_points)]


def _seen_instead(found: list[Detection], min_confidence: float) -> str:
    """Return the end of a sentence that says what was seen, or nearly."""
    if not found:
        return ""
    seen = ", ".join(f"{d.label} {d.confidence:.2f}" for d in sorted(found, key=lambda d: -d.confidence)[:5])
    return f"; it saw {seen} (confidence, what counts is above {min_confidence:g})"


def _require_depth(frame: RgbdFrame) -> None:
    if not (frame.depth_m > 0).any():
        raise NoDepthError(
            "the depth image holds no measurement (all zero); check that the lens is free, that it is light enough and "
            "that the object is more than 0.07 m away."
        )

"""Assembly of a grasp selector from a configuration, and its warm-up on a synthetic scene."""

from __future__ import annotations

import logging
from contextlib import suppress

import numpy as np

from hal.base import z1
from hal.base.messages import Intrinsics, RgbdFrame
from models.detector.detector import labels_for
from models.factory import make_generator
from models.types import Detection, GraspGenerator
from z1_runtime.config import RuntimeConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.trajectory import MotionLimits
from z1_runtime.perception.detector import Detector, PerceptionError, make_detector, mask_box
from z1_runtime.perception.extrinsics import warm_up_extrinsics_check
from z1_runtime.perception.segmentation import Perception
from z1_runtime.planning.planner import GraspPlanner, NoPlanError
from z1_runtime.tasks.grasp_selection import GraspSelector

_LOG = logging.getLogger(__name__)

_CAN_X_M = 0.48  # middle of the range in which an object is put before the arm, 0.40 to 0.56 m
_MAX_DEPTH_M = 1.5
_INTRINSICS = Intrinsics(width=640, height=480, fx=393.0, fy=393.0, cx=319.5, cy=239.5)


def make_grasp_selector(
    config: RuntimeConfig,
    T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
    *,
    detector: Detector | None = None,
    generator: GraspGenerator | None = None,
) -> GraspSelector:
    """Return the grasp selector that `config` describes.

    Args:
        config: names of detector and generator, and all numbers.
        T_flange_camera: (4, 4) hand-eye transform.
        detector: used in place of the configured one.
        generator: used in place of the configured one.

    Raises:
        ValueError: a part is unknown, its weights are missing or wrong, or the detector does not know the class.
    """
    kinematics = Kinematics()
    detector = detector or make_detector(config.detector, config.yolo)
    check_object_class(config, detector)
    return GraspSelector(
        kinematics=kinematics,
        perception=Perception(config.perception, detector, T_flange_camera),
        generator=generator or make_generator(config.generator, config.generator_options),
        planner=GraspPlanner(kinematics, config.planner, MotionLimits.at_speed(config.speed)),
        config=config,
        T_flange_camera=T_flange_camera,
    )


def check_object_class(config: RuntimeConfig, detector: Detector) -> None:
    """Check that `detector` knows the class of `config`, before the arm moves for it.

    Raises:
        InvalidValueError: it does not.
    """
    if config.object_class and detector.classes:
        labels_for(config.object_class, detector.classes)


def warm_up_selector(selector: GraspSelector) -> None:
    """Run all stages of `selector` once on a drawn can; no camera and no arm are needed."""
    config = selector.config
    if config.perception.extrinsics_check.enabled:
        warm_up_extrinsics_check()  # no jaws are in the drawn scene
    q = np.append(z1.Q_HOME, config.jaw_home)
    T_base_camera = selector.kinematics.flange(z1.Q_HOME) @ selector.T_flange_camera
    frame = draw_can(T_base_camera)
    can = _detect_can(frame)
    filtered = selector.perception.filter_self(frame, config.jaw_home)
    with suppress(PerceptionError):  # a detector of colours finds no can in a black picture, but is warm then
        selector.perception.detect(filtered, T_base_camera)
    try:
        observation = selector.perception.segment(filtered, T_base_camera, can)
        selector.select_from(observation, q)
    except (PerceptionError, NoPlanError) as error:  # a real scene may be feasible where this one is not
        _LOG.info("the warm-up scene has no plan under this configuration: %s", error)


def _detect_can(frame: RgbdFrame) -> Detection:
    mask = frame.ground_truth_mask
    assert mask is not None
    return Detection(label="can", confidence=1.0, box_px=mask_box(mask), mask=mask)


def draw_can(T_base_camera: np.ndarray, radius_m: float = 0.03, height_m: float = 0.15) -> RgbdFrame:
    """Return an exact frame, from `T_base_camera` (4, 4), of an upright can 0.48 m in front of the base."""
    d = _INTRINSICS.rays() @ T_base_camera[:3, :3].T  # per metre of depth, in the base frame
    eye = T_base_camera[:3, 3] - [_CAN_X_M, 0.0, 0.0]

    with np.errstate(divide="ignore", invalid="ignore"):
        table = np.where(d[..., 2] < 0, -eye[2] / d[..., 2], np.inf)
        a = d[..., 0] ** 2 + d[..., 1] ** 2
        b = d[..., 0] * eye[0] + d[..., 1] * eye[1]
        side = (-b - np.sqrt(b**2 - a * (eye[0] ** 2 + eye[1] ** 2 - radius_m**2))) / a
        side_z = eye[2] + side * d[..., 2]
        side = np.where((side_z > 0) & (side_z < height_m), side, np.inf)
        lid = np.where(d[..., 2] < 0, (height_m - eye[2]) / d[..., 2], np.inf)
        lid_off = (eye[0] + lid * d[..., 0]) ** 2 + (eye[1] + lid * d[..., 1]) ** 2
        lid = np.where(lid_off < radius_m**2, lid, np.inf)
    depth = np.minimum(table, np.fmin(side, lid))
    depth[~(depth < _MAX_DEPTH_M)] = 0.0
    return RgbdFrame(
        colour=np.zeros((*depth.shape, 3), np.uint8),
        depth_m=depth,
        intrinsics=_INTRINSICS,
        stamp_s=0.0,
        sequence=0,
        ground_truth_mask=np.fmin(side, lid) < table,
    )

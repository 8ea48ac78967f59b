"""Assembly of a grasp selector from a configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hal.base import z1
from models.detector.detector import YoloConfig, labels_for
from models.factory import GeneratorOptions, make_generator
from models.types import GraspGenerator
from z1_runtime.config import RuntimeConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.trajectory import MotionLimits
from z1_runtime.perception.detector import Detector, make_detector
from z1_runtime.perception.segmentation import Perception
from z1_runtime.planning.planner import GraspPlanner
from z1_runtime.tasks.grasp_selection import GraspSelector


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
    detector = detector or make_detector(config.detector, _yolo_config(config))
    check_object_class(config, detector)
    return GraspSelector(
        kinematics=kinematics,
        perception=Perception(config.perception, detector, T_flange_camera),
        generator=generator or make_generator(config.generator, _generator_options(config)),
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


def _yolo_config(config: RuntimeConfig) -> YoloConfig:
    return YoloConfig(
        weights=Path(config.detector_weights) if config.detector_weights else None,
        runtime=config.detector_runtime,
        min_confidence=config.detector_confidence,
        mirrored=config.detector_mirrored,
    )


def _generator_options(config: RuntimeConfig) -> GeneratorOptions:
    return GeneratorOptions(
        weights=Path(config.generator_weights) if config.generator_weights else None,
        process=config.generator_process,
        python=Path(config.generator_python) if config.generator_python else None,
    )

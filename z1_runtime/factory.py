"""Assembly of a grasp selector from a configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hal.base import z1
from models.detector.detector import YoloConfig, labels_for
from models.factory import GeneratorOptions, make_generator
from z1_runtime.config import RuntimeConfig
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.trajectory import MotionLimits
from z1_runtime.perception.detectors import make_detector
from z1_runtime.perception.segmentation import Perception
from z1_runtime.planning.planner import GraspPlanner
from z1_runtime.tasks.grasp_selection import GraspSelector


def make_grasp_selector(config: RuntimeConfig, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA) -> GraspSelector:
    """Return the grasp selector that `config` describes.

    Args:
        config: names of detector and generator, and all numbers.
        T_flange_camera: (4, 4) hand-eye transform.

    Raises:
        ValueError: a part is unknown, its weights are missing or wrong, or the detector does not know the class.
    """
    kinematics = Kinematics()
    detector = make_detector(config.detector, _yolo_config(config))
    if config.object_class and detector.classes:
        labels_for(config.object_class, detector.classes)  # rejected now rather than before the object
    return GraspSelector(
        kinematics=kinematics,
        perception=Perception(config.perception, detector, T_flange_camera),
        generator=make_generator(config.generator, _generator_options(config)),
        planner=GraspPlanner(kinematics, config.planner, MotionLimits.at_speed(config.speed)),
        config=config,
        T_flange_camera=T_flange_camera,
    )


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

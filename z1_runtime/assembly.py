"""Puts the stages of a decision together from a configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hal import z1
from models.generators import GeneratorOptions, make_generator
from z1_runtime.config import RuntimeConfig
from z1_runtime.decision import Decider
from z1_runtime.detectors import make_detector
from z1_runtime.kinematics import Kinematics
from z1_runtime.perception import Perception
from z1_runtime.planner import GraspPlanner
from z1_runtime.trajectory import MotionLimits


def make_decider(config: RuntimeConfig, T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA) -> Decider:
    """Return the decider that `config` describes.

    Args:
        config: which detector, generator, planner, and their numbers.
        T_flange_camera: (4, 4) hand-eye transform.
    """
    kinematics = Kinematics()
    return Decider(
        kinematics=kinematics,
        perception=Perception(config.perception, make_detector(config.detector), T_flange_camera),
        generator=make_generator(config.generator, _generator_options(config)),
        planner=GraspPlanner(kinematics, config.planner, MotionLimits.at_speed(config.speed)),
        config=config,
        T_flange_camera=T_flange_camera,
    )


def _generator_options(config: RuntimeConfig) -> GeneratorOptions:
    return GeneratorOptions(
        weights=Path(config.generator_weights) if config.generator_weights else None,
        process=config.generator_process,
        python=Path(config.generator_python) if config.generator_python else None,
    )

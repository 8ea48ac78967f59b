"""Puts the stages of a decision together from a configuration."""

from __future__ import annotations

import numpy as np

from hal import z1
from models.antipodal import AntipodalSampler
from models.types import GraspGenerator
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
        perception=Perception(config.perception, make_detector(config.detector)),
        generator=make_generator(config.generator),
        planner=GraspPlanner(kinematics, config.planner, MotionLimits.at_speed(config.speed)),
        config=config,
        T_flange_camera=T_flange_camera,
    )


def make_generator(name: str) -> GraspGenerator:
    """Return the grasp generator called `name`; what it needs is imported only here.

    Raises:
        ValueError: no generator is called that, or its weights are missing or damaged.
    """
    if name == "antipodal":
        return AntipodalSampler()
    if name == "diffusion":
        from models.graspgen.sampler import DiffusionSampler

        return DiffusionSampler()
    raise ValueError(f"unknown generator {name!r}; known: antipodal, diffusion.")

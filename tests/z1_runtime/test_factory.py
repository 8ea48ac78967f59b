"""A configuration becomes a decider made of the parts it names; generators are chosen by name."""

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import ConfigError
from models.diffusion.sampler import DiffusionSampler
from models.diffusion.training.grippers import GRIPPERS
from models.factory import make_generator
from models.samplers.antipodal import AntipodalSampler
from z1_runtime.config import RuntimeConfig, load_config
from z1_runtime.factory import make_grasp_selector
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.planning.planner_config import PlannerConfig


def test_each_name_makes_its_generator():
    assert isinstance(make_generator("antipodal"), AntipodalSampler)
    assert isinstance(make_generator("diffusion"), DiffusionSampler)
    beak = make_generator("diffusion_z1")
    assert isinstance(beak, DiffusionSampler)
    assert (beak.config.gripper, beak.config.max_width_m) == ("z1", GRIPPERS["z1"].max_width_m)


def test_an_unknown_generator_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match="antipodal, obb_sweep, diffusion"):
        make_generator("oracle")
    path = tmp_path / "config.yaml"
    path.write_text("generator: oracle\n")
    with pytest.raises(ConfigError, match="antipodal, obb_sweep, diffusion"):
        load_config(path)


def test_a_file_may_choose_a_generator_without_learning(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("generator: antipodal\n")
    assert load_config(path).generator == "antipodal"
    assert RuntimeConfig().generator == "diffusion"


def test_the_parts_get_the_configuration_s_numbers():
    config = replace(RuntimeConfig(), speed=0.25, planner=PlannerConfig(lift_m=0.05))
    moved = z1.T_FLANGE_CAMERA.copy()
    moved[0, 3] += 0.01
    decider = make_grasp_selector(config, moved)
    assert decider.config is config
    assert decider.planner.config.lift_m == 0.05
    assert decider.planner._limits.velocity == pytest.approx(MotionLimits.at_speed(0.25).velocity)
    assert np.array_equal(decider.T_flange_camera, moved)
    assert isinstance(decider.generator, DiffusionSampler)


def test_planner_and_decider_share_one_model_of_the_arm():
    decider = make_grasp_selector(RuntimeConfig())
    assert decider.planner._kinematics is decider.kinematics


def test_an_unknown_detector_is_refused_by_name():
    with pytest.raises(ValueError, match="detector is 'yolo9000'; allowed is tabletop or truth or yolo"):
        replace(RuntimeConfig(), detector="yolo9000")

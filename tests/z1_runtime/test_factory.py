"""A configuration becomes a selector made of the parts it names; generators are chosen by name."""

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import ConfigError, InvalidValueError, UsageError
from models.diffusion.sampler import DiffusionSampler
from models.diffusion.training.grippers import GRIPPERS
from models.factory import make_generator
from models.samplers.antipodal import AntipodalSampler
from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig, load_config
from z1_runtime.factory import make_grasp_selector
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.planning.config import PlannerConfig


@pytest.mark.integration
def test_each_name_makes_its_generator():
    assert isinstance(make_generator("antipodal"), AntipodalSampler)
    assert isinstance(make_generator("diffusion"), DiffusionSampler)
    for_z1 = make_generator("diffusion_z1")
    assert isinstance(for_z1, DiffusionSampler)
    assert (for_z1.config.gripper, for_z1.config.max_width_m) == ("z1", GRIPPERS["z1"].max_width_m)


def test_an_unknown_generator_is_rejected_with_the_known_ones(tmp_path):
    with pytest.raises(UsageError) as unknown:
        make_generator("oracle")
    assert "antipodal, obb_sweep, diffusion" in str(unknown.value)
    path = tmp_path / "config.yaml"
    path.write_text("generator: oracle\n")
    with raises(ConfigError, "out_of_range"):
        load_config(path)


def test_a_file_may_choose_a_generator_without_learning(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("generator: antipodal\n")
    assert load_config(path).generator == "antipodal"
    assert RuntimeConfig().generator == "diffusion"


@pytest.mark.integration
def test_the_parts_get_the_configuration_s_numbers():
    config = replace(RuntimeConfig(), speed=0.25, planner=PlannerConfig(lift_m=0.05))
    moved = z1.T_FLANGE_CAMERA.copy()
    moved[0, 3] += 0.01
    selector = make_grasp_selector(config, moved)
    assert selector.config is config
    assert selector.planner.config.lift_m == 0.05
    assert selector.planner._limits.velocity == pytest.approx(MotionLimits.at_speed(0.25).velocity)
    assert np.array_equal(selector.T_flange_camera, moved)
    assert isinstance(selector.generator, DiffusionSampler)


@pytest.mark.integration
def test_planner_and_selector_share_one_model_of_the_arm():
    selector = make_grasp_selector(RuntimeConfig())
    assert selector.planner._kinematics is selector.kinematics


def test_an_unknown_detector_is_rejected_by_name():
    with raises(InvalidValueError, "invalid_value"):
        replace(RuntimeConfig(), detector="yolo9000")

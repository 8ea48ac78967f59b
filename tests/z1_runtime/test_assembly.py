"""A configuration becomes a decider made of the parts it names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal import z1
from models.antipodal import AntipodalSampler
from z1_runtime.assembly import make_decider
from z1_runtime.config import RuntimeConfig
from z1_runtime.motion_limits import MotionLimits
from z1_runtime.planner import PlannerConfig


def test_the_parts_get_the_configuration_s_numbers():
    config = replace(RuntimeConfig(), speed=0.25, planner=PlannerConfig(lift_m=0.05))
    moved = z1.T_FLANGE_CAMERA.copy()
    moved[0, 3] += 0.01
    decider = make_decider(config, moved)
    assert decider.config is config
    assert decider.planner.config.lift_m == 0.05
    assert decider.planner._limits.velocity == pytest.approx(MotionLimits.at_speed(0.25).velocity)
    assert np.array_equal(decider.T_flange_camera, moved)
    assert isinstance(decider.generator, AntipodalSampler)


def test_planner_and_decider_share_one_model_of_the_arm():
    decider = make_decider(RuntimeConfig())
    assert decider.planner._kinematics is decider.kinematics


def test_an_unknown_detector_is_refused_by_name():
    with pytest.raises(ValueError, match="no detector 'yolo9000'"):
        make_decider(replace(RuntimeConfig(), detector="yolo9000"))

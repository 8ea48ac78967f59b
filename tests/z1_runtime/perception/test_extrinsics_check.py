"""The jaws in the picture show the extrinsics; other surfaces are not mistaken for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame
from hal.base.transforms import inverse, transform_points
from sim_twin.benchmark.episodes.execution import capture
from sim_twin.model.scene import SceneConfig
from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector
from z1_runtime.perception.extrinsics import ExtrinsicsCheck
from z1_runtime.perception.self_filter import SelfFilter

AHEAD = np.array([[0.0, 0.0, 0.4]])
CHECK = ExtrinsicsCheck()


def taken(scene: SceneConfig) -> tuple[RgbdFrame, float, np.ndarray]:
    """Return the twin's frame from home, the jaw angle, and the true extrinsics (4, 4)."""
    frame, q = capture(scene)
    return frame, float(q[-1]), scene.T_flange_camera()


def gripper(frame: RgbdFrame, jaw: float) -> np.ndarray:
    return SelfFilter().gripper_pixels(frame, jaw)


def offset_m(T_flange_camera: np.ndarray, T_true: np.ndarray) -> float:
    """Return the error of a point 0.4 m ahead of the lens under these extrinsics [m]."""
    return float(np.linalg.norm(transform_points(inverse(T_true) @ T_flange_camera, AHEAD) - AHEAD))


@pytest.fixture(scope="module")
def straight() -> tuple[RgbdFrame, float, np.ndarray]:
    return taken(SceneConfig(object="bottle"))


@pytest.mark.integration
@pytest.mark.parametrize("seed", [1, 3])
def test_wrong_extrinsics_are_corrected_by_the_jaws_in_view(seed: int) -> None:
    scene = SceneConfig(object="bottle", mount_error_m=0.003, mount_error_deg=1.0, mount_seed=seed)
    frame, jaw, T_true = taken(scene)
    before = offset_m(z1.T_FLANGE_CAMERA, T_true)
    seen = CHECK.correct(frame, gripper(frame, jaw), jaw, z1.T_FLANGE_CAMERA)
    assert seen is not None
    assert seen.correction_m == pytest.approx(before, abs=0.002)
    assert offset_m(seen.T_flange_camera, T_true) < min(0.0025, 0.6 * before)


@pytest.mark.integration
def test_right_extrinsics_stay(straight: tuple[RgbdFrame, float, np.ndarray]) -> None:
    frame, jaw, T_true = straight
    assert T_true == pytest.approx(z1.T_FLANGE_CAMERA, abs=1e-6)
    seen = CHECK.estimate(frame, gripper(frame, jaw), jaw, z1.T_FLANGE_CAMERA)
    assert seen is not None
    assert seen.correction_m < CHECK.min_correction_m
    assert seen.inlier_ratio > 0.85
    assert CHECK.correct(frame, gripper(frame, jaw), jaw, z1.T_FLANGE_CAMERA) is None


def test_without_the_jaws_in_view_there_is_no_estimate(straight: tuple[RgbdFrame, float, np.ndarray]) -> None:
    frame, jaw, _ = straight
    blind = replace(frame, depth_m=np.zeros_like(frame.depth_m))
    assert CHECK.estimate(blind, gripper(blind, jaw), jaw, z1.T_FLANGE_CAMERA) is None
    assert CHECK.correct(blind, gripper(blind, jaw), jaw, z1.T_FLANGE_CAMERA) is None


def test_a_card_in_front_of_the_jaws_is_not_mistaken_for_them(straight: tuple[RgbdFrame, float, np.ndarray]) -> None:
    frame, jaw, _ = straight
    card = replace(frame, depth_m=np.full_like(frame.depth_m, 0.09))
    assert CHECK.correct(card, gripper(card, jaw), jaw, z1.T_FLANGE_CAMERA) is None


@pytest.mark.integration
def test_perception_uses_the_corrected_extrinsics_and_warns_once(caplog: pytest.LogCaptureFixture) -> None:
    scene = SceneConfig(object="bottle", mount_error_m=0.003, mount_error_deg=1.0, mount_seed=3)
    frame, jaw, T_true = taken(scene)
    selector = make_grasp_selector(RuntimeConfig(detector="tabletop", generator="antipodal"))
    q = np.append(z1.Q_HOME, jaw)
    with caplog.at_level("WARNING", "z1_runtime.perception.segmentation"):
        seen = [selector.observe(frame, q) for _ in range(2)]
    T_base_flange = selector.kinematics.flange(z1.Q_HOME)
    assert offset_m(z1.T_FLANGE_CAMERA, T_true) > 0.004
    for observation in seen:
        assert offset_m(inverse(T_base_flange) @ observation.T_base_camera, T_true) < 0.0025
    assert caplog.text.count("calibrate the camera") == 1


@pytest.mark.integration
def test_it_can_be_switched_off() -> None:
    scene = SceneConfig(object="bottle", mount_error_m=0.003, mount_error_deg=1.0, mount_seed=1)
    frame, jaw, _ = taken(scene)
    assert ExtrinsicsCheck(enabled=False).correct(frame, gripper(frame, jaw), jaw, z1.T_FLANGE_CAMERA) is None


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"min_correction_m": 0.03}, "correction"),
        ({"min_inlier_ratio": 0.0}, "min_inlier_ratio"),
        ({"max_rms_m": 1.0}, "max_rms_m"),
        ({"points": 10}, "points"),
    ],
)
def test_values_out_of_range_are_rejected(wrong: dict, code: str) -> None:
    with raises(InvalidValueError, code):
        ExtrinsicsCheck(**wrong)

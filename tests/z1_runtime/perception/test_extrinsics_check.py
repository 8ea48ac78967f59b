"""The jaws in the picture tell where the camera sits; what is not the jaws tells nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.messages import RgbdFrame
from hal.base.transforms import inverse, transform_points
from sim_twin.benchmark.episodes.execution import capture
from sim_twin.model.scene import SceneConfig
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector
from z1_runtime.perception.extrinsics_check import ExtrinsicsCheck

AHEAD = np.array([[0.0, 0.0, 0.4]])
SIGHT = ExtrinsicsCheck()


def taken(scene: SceneConfig) -> tuple[RgbdFrame, float, np.ndarray]:
    """Return the twin's frame from home, the jaw's angle, and where its camera truly sits on the flange."""
    frame, q = capture(scene)
    return frame, float(q[-1]), scene.T_flange_camera()


def beside_m(T_flange_camera: np.ndarray, T_true: np.ndarray) -> float:
    """Return how far beside its place a mount shows what is 0.4 m ahead [m]."""
    return float(np.linalg.norm(transform_points(inverse(T_true) @ T_flange_camera, AHEAD) - AHEAD))


@pytest.fixture(scope="module")
def straight() -> tuple[RgbdFrame, float, np.ndarray]:
    return taken(SceneConfig(object="bottle"))


@pytest.mark.parametrize("seed", [1, 3])
def test_a_camera_off_its_mount_is_found_by_the_jaws_it_sees(seed: int) -> None:
    scene = SceneConfig(object="bottle", mount_error_m=0.003, mount_error_deg=1.0, mount_seed=seed)
    frame, jaw, T_true = taken(scene)
    before = beside_m(z1.T_FLANGE_CAMERA, T_true)
    seen = SIGHT.correct(frame, jaw, z1.T_FLANGE_CAMERA)
    assert seen is not None
    assert seen.moved_m == pytest.approx(before, abs=0.002)
    assert beside_m(seen.T_flange_camera, T_true) < min(0.0025, 0.6 * before)


def test_a_camera_that_sits_where_it_should_is_left_there(straight: tuple[RgbdFrame, float, np.ndarray]) -> None:
    frame, jaw, T_true = straight
    assert T_true == pytest.approx(z1.T_FLANGE_CAMERA, abs=1e-6)
    seen = SIGHT.see(frame, jaw, z1.T_FLANGE_CAMERA)
    assert seen is not None
    assert seen.moved_m < SIGHT.least_m
    assert seen.share > 0.85
    assert SIGHT.correct(frame, jaw, z1.T_FLANGE_CAMERA) is None


def test_without_the_jaws_in_view_nothing_is_seen(straight: tuple[RgbdFrame, float, np.ndarray]) -> None:
    frame, jaw, _ = straight
    blind = replace(frame, depth_m=np.zeros_like(frame.depth_m))
    assert SIGHT.see(blind, jaw, z1.T_FLANGE_CAMERA) is None
    assert SIGHT.correct(blind, jaw, z1.T_FLANGE_CAMERA) is None


def test_a_card_before_the_jaws_is_not_taken_for_them(straight: tuple[RgbdFrame, float, np.ndarray]) -> None:
    frame, jaw, _ = straight
    card = replace(frame, depth_m=np.full_like(frame.depth_m, 0.09))
    assert SIGHT.correct(card, jaw, z1.T_FLANGE_CAMERA) is None


def test_a_decider_sees_by_the_mount_that_the_jaws_show_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    scene = SceneConfig(object="bottle", mount_error_m=0.003, mount_error_deg=1.0, mount_seed=3)
    frame, jaw, T_true = taken(scene)
    decider = make_grasp_selector(RuntimeConfig(detector="tabletop", generator="antipodal"))
    q = np.append(z1.Q_HOME, jaw)
    with caplog.at_level("WARNING", "z1_runtime.tasks.grasp_selection"):
        seen = [decider.observe(frame, q) for _ in range(2)]
    T_base_flange = decider.kinematics.flange(z1.Q_HOME)
    assert beside_m(z1.T_FLANGE_CAMERA, T_true) > 0.004
    for observation in seen:
        assert beside_m(inverse(T_base_flange) @ observation.T_base_camera, T_true) < 0.0025
    assert caplog.text.count("calibrate the camera") == 1


def test_it_can_be_switched_off() -> None:
    scene = SceneConfig(object="bottle", mount_error_m=0.003, mount_error_deg=1.0, mount_seed=1)
    frame, jaw, _ = taken(scene)
    assert ExtrinsicsCheck(enabled=False).correct(frame, jaw, z1.T_FLANGE_CAMERA) is None


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"least_m": 0.03}, "least_m and most_m are 0.03 and 0.02"),
        ({"least_share": 0.0}, "least_share is 0.0"),
        ({"most_rms_m": 1.0}, "most_rms_m is 1.0"),
        ({"points": 10}, "points is 10; allowed is 300 or more"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(wrong: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ExtrinsicsCheck(**wrong)

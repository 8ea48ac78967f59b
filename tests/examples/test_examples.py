"""Every example runs, is short, and does what its first line states."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_model import ForwardKinematics
from z1_runtime import Robot

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MAX_LINES = 30


def load(name: str) -> dict[str, Any]:
    """Return the names that an example defines."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_example_fits_on_a_screen_and_has_a_test(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MAX_LINES
    assert f'"{path.stem}"' in Path(__file__).read_text()


@pytest.mark.integration  # the default detector and generator take seconds to load
def test_pick_bottle_holds_it() -> None:
    assert load("pick_bottle")["main"]()


@pytest.mark.integration
def test_grabbed_cloud_holds_table_and_object() -> None:
    cloud = load("grab_frame_and_cloud")["main"]()
    assert len(cloud) > 50_000
    assert np.mean(np.abs(cloud[:, 2]) < 0.01) > 0.2
    assert cloud[:, 2].max() > 0.05


@pytest.mark.integration
def test_moved_arm_is_at_the_pose() -> None:
    state = load("move_arm")["main"]()
    kinematics = ForwardKinematics()
    rise_m = kinematics.pivot(state.q[: z1.N_ARM])[2, 3] - kinematics.pivot(z1.Q_HOME)[2, 3]
    assert rise_m == pytest.approx(0.03, abs=2e-3)
    assert state.q[-1] == pytest.approx(-0.5, abs=5e-3)


@pytest.mark.integration
def test_own_generator_holds_the_box() -> None:
    assert load("own_generator")["main"]()


@pytest.mark.integration
def test_own_detector_holds_the_box() -> None:
    with Robot.simulate("box", detector=load("own_detector")["NearestObject"]()) as robot:
        assert robot.pick().held


def test_ranked_grasps_pass_the_filter_in_order() -> None:
    ranked = load("rank_grasps_with_the_box")["main"]()
    assert 0 < len(ranked) < 200
    assert (np.diff(ranked.scores) <= 0.0).all()

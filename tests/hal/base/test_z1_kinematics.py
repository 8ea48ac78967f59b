"""Inverse kinematics within the joint limits, and postures."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base import z1
from hal.base.z1_kinematics import PivotKinematics, pose_from_posture, posture_from_pose

NEAR = np.array(z1.Q_HOME)


@pytest.fixture(scope="module")
def kinematics() -> PivotKinematics:
    return PivotKinematics()


@pytest.mark.parametrize("seed", range(5))
def test_inverse_kinematics_reach_the_pose_within_the_limits(kinematics: PivotKinematics, seed: int) -> None:
    T = kinematics.forward(np.random.default_rng(seed).uniform(z1.Q_MIN[:6], z1.Q_MAX[:6]))
    q = kinematics.inverse(T, NEAR)
    assert q is not None
    assert (q >= z1.Q_MIN[:6]).all()
    assert (q <= z1.Q_MAX[:6]).all()
    assert kinematics.forward(q) == pytest.approx(T, abs=1e-5)


def test_the_solution_nearest_to_the_given_joints_is_taken_within_the_maximum_change(
    kinematics: PivotKinematics,
) -> None:
    T = kinematics.forward(NEAR)
    assert kinematics.inverse(T, NEAR + 0.1, 0.2) == pytest.approx(NEAR, abs=1e-5)
    assert kinematics.inverse(T, NEAR + 0.1, 0.05) is None


def test_an_unreachable_pose_has_no_solution(kinematics: PivotKinematics) -> None:
    assert kinematics.inverse(pose_from_posture(np.array([0, 0, 0, 2.0, 0, 0.4])), NEAR) is None


@pytest.mark.parametrize("seed", range(5))
def test_postures_and_poses_are_converted_in_both_directions(seed: int) -> None:
    posture = np.random.default_rng(seed).uniform(-1.5, 1.5, 6)
    assert posture_from_pose(pose_from_posture(posture)) == pytest.approx(posture)

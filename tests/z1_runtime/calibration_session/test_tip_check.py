"""Tip check: the tip of the closed jaws moves over corners of the board, with a table plane and a mock arm."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.board.board import Board
from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import transform_points
from tests.support.errors import raises
from tests.support.lockstep import Bench
from tests.z1_runtime.calibration_session.test_viewpoints import HOME, flat_board, frame_from_home
from z1_runtime.calibration_session.tip_check import T_PIVOT_TIP, TipCheck, TipCheckConfig, TipMeasurement
from z1_runtime.calibration_session.viewpoints import scan_scene
from z1_runtime.geometry.kinematics import Kinematics

BOARD = Board()


@pytest.fixture(scope="module")
def kinematics() -> Kinematics:
    return Kinematics()


def touch(kinematics: Kinematics, T_base_board: np.ndarray, **config) -> tuple[Bench, list[TipMeasurement]]:
    bench = Bench(HOME)
    checker = scan_scene(kinematics, frame_from_home(kinematics), HOME)
    test = TipCheck(bench.servo, bench.clock, BOARD, TipCheckConfig(speed=1.0, **config))
    return bench, list(test.run(T_base_board, checker))


@pytest.mark.integration
def test_the_tip_is_brought_over_corners_far_apart(kinematics):
    T_base_board = flat_board(0.495, 0.10)
    _, touches = touch(kinematics, T_base_board, n=4, height_m=0.005)
    assert [one.corner for one in touches][:2] == [0, len(BOARD.corners_m) - 1]
    for one in touches:
        corner = transform_points(T_base_board, BOARD.corners_m[one.corner])
        assert not one.failure
        assert np.allclose(one.p_base_target - corner, [0.0, 0.0, 0.005])
        assert np.linalg.norm(one.p_base_tip - one.p_base_target) < 2e-4  # the mock arm follows well


@pytest.mark.integration
def test_the_tip_comes_from_above_and_leaves_the_same_way(kinematics):
    bench, (one,) = touch(kinematics, flat_board(0.495, 0.10), n=1, approach_m=0.04)
    tip = (kinematics.pivot(bench.servo.read_state().q[: z1.N_ARM]) @ T_PIVOT_TIP)[:3, 3]
    assert np.linalg.norm(tip - one.p_base_target - [0.0, 0.0, 0.04]) < 2e-4


@pytest.mark.integration
def test_a_corner_out_of_reach_is_left_out_with_the_reason(kinematics):
    bench, (one,) = touch(kinematics, flat_board(1.2, 0.10), n=1)
    assert "no inverse kinematics solution" in one.failure and np.isnan(one.p_base_tip).all()
    assert np.allclose(bench.servo.read_state().q, HOME)


@pytest.mark.parametrize("wrong", [{"height_m": 0.0}, {"n": 0}, {"approach_m": 1.0}, {"height_m": float("nan")}])
def test_check_that_would_hit_the_board_is_rejected(wrong: dict):
    with raises(InvalidValueError, "invalid_value"):
        TipCheckConfig(**wrong)

"""The tip of the closed jaws goes over corners of the board, as a table plane and a mock arm see it."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.board.board import Board
from hal.base import z1
from tests.support.lockstep import Bench
from tests.z1_runtime.calibration_session.test_viewpoints import HOME, frame_from_home, lying
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


def test_the_tip_is_brought_over_corners_far_apart(kinematics):
    T_base_board = lying(0.495, 0.10)
    _, touches = touch(kinematics, T_base_board, n=4, height_m=0.005)
    assert [one.corner for one in touches][:2] == [0, len(BOARD.corners_m) - 1]
    for one in touches:
        corner = T_base_board[:3, :3] @ BOARD.corners_m[one.corner] + T_base_board[:3, 3]
        assert not one.problem
        assert np.allclose(one.p_base_target - corner, [0.0, 0.0, 0.005])
        assert np.linalg.norm(one.p_base_tip - one.p_base_target) < 2e-4  # the mock arm follows well


def test_the_tip_comes_from_above_and_leaves_the_same_way(kinematics):
    bench, (one,) = touch(kinematics, lying(0.495, 0.10), n=1, approach_m=0.04)
    tip = (kinematics.pivot(bench.servo.read_state().q[: z1.N_ARM]) @ T_PIVOT_TIP)[:3, 3]
    assert np.linalg.norm(tip - one.p_base_target - [0.0, 0.0, 0.04]) < 2e-4


def test_a_corner_out_of_reach_is_left_out_with_the_reason(kinematics):
    bench, (one,) = touch(kinematics, lying(1.2, 0.10), n=1)
    assert "no joints reach it" in one.problem and np.isnan(one.p_base_tip).all()
    assert np.allclose(bench.servo.read_state().q, HOME)


@pytest.mark.parametrize("wrong", [{"height_m": 0.0}, {"n": 0}, {"approach_m": 1.0}, {"height_m": float("nan")}])
def test_a_test_that_would_hit_the_board_is_refused(wrong: dict):
    with pytest.raises(ValueError, match=r"allowed are 1 and more, 0\.001 to 0\.05 m"):
        TipCheckConfig(**wrong)

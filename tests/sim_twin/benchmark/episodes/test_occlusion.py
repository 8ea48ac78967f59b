import numpy as np
import pytest

from hal.base import z1
from sim_twin.benchmark.episodes.occlusion import occlude
from z1_runtime.factory import draw_can
from z1_runtime.geometry.kinematics import Kinematics


@pytest.fixture(scope="module")
def frame():
    return draw_can(Kinematics().flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA)


@pytest.mark.parametrize("share", [0.25, 0.5])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_asked_share_of_the_object_is_hidden_in_mask_and_depth(frame, share, seed):
    hidden = occlude(frame, share, seed)
    left = hidden.ground_truth_mask.sum() / frame.ground_truth_mask.sum()
    assert left == pytest.approx(1.0 - share, abs=0.02)
    gone = frame.ground_truth_mask & ~hidden.ground_truth_mask
    assert not hidden.depth_m[gone].any()
    assert np.array_equal(hidden.depth_m[hidden.ground_truth_mask], frame.depth_m[hidden.ground_truth_mask])


def test_most_of_the_table_stays_in_view(frame):
    hidden = occlude(frame, 0.5, 0)
    assert (hidden.depth_m > 0).sum() > 0.9 * (frame.depth_m > 0).sum()


def test_nothing_hidden_is_the_very_frame(frame):
    assert occlude(frame, 0.0, 0) is frame

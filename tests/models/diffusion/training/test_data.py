"""Training batches: augmentation, and grasps drawn from shards."""

import numpy as np
import pytest
import torch

from models.diffusion.cloud import N_POINTS
from models.diffusion.network import decode_grasps, encode_grasps
from models.diffusion.training.data import augment
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labels import check_grasps

GRIPPER = GRIPPERS["agnostic"]


@pytest.mark.parametrize("symmetric", [True, False])
def test_augmentation_keeps_grasps_at_their_points(symmetric):
    torch.manual_seed(0)
    cloud = torch.randn(3, N_POINTS, 6) * 0.04
    T = torch.eye(4).repeat(3, 5, 1, 1)
    T[..., :3, 3] = cloud[:, :5, :3]
    moved_cloud, moved = augment(cloud, encode_grasps(T, torch.full((3, 5), 0.05)), symmetric)
    positions = decode_grasps(moved)[0][..., :3, 3]
    assert (positions - moved_cloud[:, :5, :3]).norm(dim=-1).max() < 0.003  # the points' own jitter


def test_only_a_symmetric_gripper_is_turned_over():
    torch.manual_seed(0)
    T = torch.eye(4).repeat(40, 6, 1, 1)
    grasps = encode_grasps(T, torch.full((40, 6), 0.05))
    cloud = torch.zeros(40, N_POINTS, 6)
    for symmetric in (True, False):
        closing = augment(cloud, grasps, symmetric)[1][..., 6:9]
        same_side = (closing * closing[:, :1]).sum(-1) > 0.0  # within a cloud all were equal before
        assert same_side.all() != symmetric


@pytest.mark.integration
def test_ground_truth_in_the_view_frame_is_valid_on_the_solid(data):
    T, widths = data.draw_grasps(np.arange(8), 30, np.random.default_rng(0))
    for view in range(8):
        T_object = np.linalg.inv(data.T_view_object[view].astype(np.float64)) @ T[view]
        check = check_grasps(data.solid(view), T_object, GRIPPER)
        assert check.valid.mean() > 0.95
        assert np.nanmedian(np.abs(check.widths_m - widths[view])) < 1e-3


def test_grasps_from_the_cameras_side_are_drawn_more_often(data):
    T, _ = data.draw_grasps(np.arange(8), 400, np.random.default_rng(0))
    everywhere = (data.T_view_object[:, None] @ data.grasps[data.shape])[:, :, 2, 2]
    assert T[:, :, 2, 2].mean() > everywhere.mean() + 0.05

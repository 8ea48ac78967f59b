"""The networks' coordinates of grasps."""

import numpy as np
import pytest
import torch

from models.diffusion.network import decode_grasps, encode_grasps


def test_grasps_round_trip_through_coordinates():
    T = np.tile(np.eye(4), (20, 1, 1))
    for k in range(20):
        R = np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0]
        T[k, :3, :3] = R * np.linalg.det(R)
        T[k, :3, 3] = np.random.default_rng(k).normal(size=3) * 0.05
    widths = torch.linspace(0.01, 0.1, 20, dtype=torch.float64)
    back, widths_back = decode_grasps(encode_grasps(torch.from_numpy(T), widths))
    assert back.numpy() == pytest.approx(T, abs=1e-9)
    assert widths_back.numpy() == pytest.approx(widths.numpy())


def test_any_coordinates_decode_to_rotations():
    R = decode_grasps(torch.randn(50, 10, dtype=torch.float64))[0][:, :3, :3].numpy()
    assert R @ R.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (50, 1, 1)), abs=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)

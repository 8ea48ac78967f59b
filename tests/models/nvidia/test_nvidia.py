"""NVIDIA's samplers as generators, without their packages: frames, order, ops, folding, device."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from hal.base import z1
from hal.base.errors import InvalidValueError
from models.factory import GeneratorOptions, generator_for, make_generator, split_generator_name
from models.nvidia import pointnet_ops
from models.nvidia.errors import GeneratorError
from models.nvidia.graspgenx import Z1_GRIPPER, sweep_numbers
from models.nvidia.nvidia import NvidiaSampler, make_nvidia_generator
from models.nvidia.torch_patches import cuda_if_available, fold_attention, replace_compiled_ops, seed_random_numbers
from models.weights_file import WeightsError
from tests.support.errors import raises

CLOUD = np.random.default_rng(0).uniform([-0.03, -0.05, 0.38], [0.03, 0.05, 0.42], (500, 3))
DEPTH_M = 0.195


class FakeSampler:
    """Sampler with given poses and unsorted scores, for a centred cloud."""

    def __init__(self, T: np.ndarray, scores: list[float]) -> None:
        self.T, self.scores, self.cloud = torch.from_numpy(T).float(), torch.tensor(scores), torch.zeros(0)

    def sample(self, cloud, threshold, num_grasps, remove_outliers):
        assert not remove_outliers and threshold == -1.0
        self.cloud = cloud
        return self.T, self.scores, None


def tip(depth_m: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = depth_m
    return T


def test_their_base_that_closes_along_x_becomes_our_fingertips_that_close_along_y():
    T_base = np.eye(4)
    T_base[:3, :3] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # closes along +y, approaches along +x
    T_base[:3, 3] = [-0.2, 0.01, 0.02]
    theirs = FakeSampler(T_base[None], [0.5])
    grasps = NvidiaSampler(theirs, tip(DEPTH_M), "theirs").sample(CLOUD, 1, 0)
    T = grasps.T_camera_grasps[0]
    center = CLOUD.mean(axis=0)
    np.testing.assert_allclose(T[:3, 2], [1.0, 0.0, 0.0], atol=1e-6)  # approach
    np.testing.assert_allclose(T[:3, 1], [0.0, 1.0, 0.0], atol=1e-6)  # closing
    np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1.0, atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], np.add(center, [-0.2 + DEPTH_M, 0.01, 0.02]), atol=1e-6)
    np.testing.assert_array_equal(T[3], [0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(theirs.cloud.mean(dim=0), 0.0, atol=1e-6)
    assert np.isnan(grasps.widths_m).all()


def test_all_grasps_are_returned_best_first():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 1.0, 2.0]
    T[:, 3, 3] = 0.0  # as GraspGenX leaves it
    grasps = NvidiaSampler(FakeSampler(T, [0.2, 0.9, 0.4]), tip(0.0), "theirs").sample(CLOUD, 3, 0)
    assert grasps.scores == pytest.approx([0.9, 0.4, 0.2])
    offsets = grasps.T_camera_grasps[:, 0, 3] - CLOUD.mean(axis=0)[0]
    assert offsets == pytest.approx([1.0, 2.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("bad", ["short", "nan"])
def test_too_few_or_non_finite_grasps_are_rejected(bad: str):
    T = np.tile(np.eye(4), (3, 1, 1))
    if bad == "nan":
        T[1, 0, 3] = np.nan
    sampler = NvidiaSampler(FakeSampler(T, [0.2, 0.9, 0.4]), tip(0.0), "theirs")
    with raises(GeneratorError, "bad_output"):
        sampler.sample(CLOUD, 4 if bad == "short" else 3, 0)


def test_a_cloud_in_millimetres_is_rejected_before_sampling():
    sampler = NvidiaSampler(FakeSampler(np.eye(4)[None], [1.0]), tip(0.0), "theirs")
    with raises(InvalidValueError, "cloud_extent"):
        sampler.sample(1000.0 * CLOUD, 1, 0)


def test_attention_to_one_token_folds_into_the_same_linear_map():
    torch.manual_seed(0)
    attention = nn.MultiheadAttention(96, 8).eval()
    nn.init.normal_(attention.in_proj_bias)
    nn.init.normal_(attention.out_proj.bias)
    layers = nn.ModuleDict({"attn": attention, "norm": nn.LayerNorm(96)})
    q, k, v = torch.randn(3, 1, 50, 96)
    with torch.inference_mode():
        expected = attention(q, k, v)[0]
        assert fold_attention(layers) == 1
        assert layers["attn"](q, k, v, attn_mask=None)[0] == pytest.approx(expected, abs=1e-5)
    assert sum(p.numel() for p in layers["attn"].parameters()) == 96 * 97
    with pytest.raises(RuntimeError):
        layers["attn"](q, k, torch.randn(2, 50, 96))


def test_other_attention_is_unchanged():
    layers = nn.ModuleList(
        [nn.MultiheadAttention(8, 2, batch_first=True), nn.MultiheadAttention(8, 2, add_zero_attn=True)]
    )
    assert fold_attention(layers) == 0


def test_sampling_takes_the_furthest_point_each_time_and_none_near_the_origin():
    points = torch.tensor([[[0.1, 0.0, 0.0], [0.01, 0.0, 0.0], [0.12, 0.0, 0.0], [-0.2, 0.0, 0.0], [0.0, 0.3, 0.0]]])
    index = pointnet_ops.furthest_point_sampling(points, 4)
    assert index.tolist() == [[0, 4, 3, 2]] and index.dtype == torch.int32
    only_near = torch.full((1, 5, 3), 0.001)
    assert pointnet_ops.furthest_point_sampling(only_near, 3).tolist() == [[0, 0, 0]]


def test_the_ops_equal_their_definition_in_loops():
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.3, 0.3, (2, 80, 3)).astype(np.float32)
    centers, features = points[:, :9], rng.normal(size=(2, 5, 80)).astype(np.float32)
    radius, count = 0.15, 6
    index = pointnet_ops.ball_query(torch.from_numpy(centers), torch.from_numpy(points), radius, count).numpy()
    for b in range(2):
        for m in range(9):
            inside = [i for i in range(80) if np.sum((points[b, i] - centers[b, m]) ** 2) < radius**2]
            expected = (inside + [inside[0]] * count)[:count]
            assert index[b, m].tolist() == expected
    grouped = pointnet_ops.group_points(torch.from_numpy(features), torch.from_numpy(index)).numpy()
    gathered = pointnet_ops.gather_points(torch.from_numpy(features), torch.from_numpy(index[:, :, 0])).numpy()
    for b in range(2):
        np.testing.assert_array_equal(grouped[b], features[b][:, index[b]])
        np.testing.assert_array_equal(gathered[b], features[b][:, index[b, :, 0]])


def test_an_empty_ball_and_one_larger_than_the_cloud_are_filled():
    points = torch.tensor([[[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]])
    far = torch.tensor([[[5.0, 0.0, 0.0]]])
    assert pointnet_ops.ball_query(far, points, 0.1, 3).tolist() == [[[0, 0, 0]]]
    assert pointnet_ops.ball_query(points[:, 1:], points, 0.1, 4).tolist() == [[[0, 1, 0, 0]]]


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA: nothing is patched")
def test_cuda_calls_do_nothing_within_and_are_restored_after():
    kept = torch.Tensor.cuda, nn.Module.cuda
    with pytest.raises(KeyError), cuda_if_available():
        assert torch.zeros(2).cuda().device.type == "cpu"
        assert nn.Linear(2, 2).cuda().weight.device.type == "cpu"
        raise KeyError
    assert (torch.Tensor.cuda, nn.Module.cuda) == kept


def test_random_numbers_within_are_seeded_and_continue_after():
    torch.manual_seed(5)
    np.random.seed(5)
    expected = torch.rand(1), np.random.rand()
    torch.manual_seed(5)
    np.random.seed(5)
    drawn = []
    for _ in range(2):
        with seed_random_numbers(9):
            drawn.append((torch.rand(1), np.random.rand()))
    assert drawn[0] == drawn[1]
    assert (torch.rand(1), np.random.rand()) == expected


def test_the_compiled_ops_are_replaced_within_only():
    with replace_compiled_ops():
        from pointnet2_ops import _ext  # type: ignore[import-not-found]

        assert _ext is pointnet_ops
    with pytest.raises(ImportError):
        import pointnet2_ops  # type: ignore[import-not-found]  # noqa: F401


def test_the_z1_s_description_is_made_from_its_measured_gripper():
    opened = 2.0 * np.arcsin(0.065 / 2.0 / z1.KNEE_RADIUS_M)  # both knees touch 65 mm
    to_axis_m = -z1.T_PIVOT_STATIONARY_JAW[0, 3]
    boxes = []
    for angle in (opened, opened / 2.0):
        between_knees = 2.0 * z1.KNEE_RADIUS_M * np.sin(angle / 2.0)
        tips = to_axis_m + z1.JAW_REACH_M * np.cos(angle / 2.0)
        palm = to_axis_m + z1.PALM_RADIUS_M
        boxes += [between_knees, 2.0 * z1.PAD_HALF_WIDTH_M, tips - palm, 0.0, 0.0, (tips + palm) / 2.0]
    assert sweep_numbers() == pytest.approx(boxes, abs=6e-4)


def test_the_z1_s_description_is_the_one_that_was_evaluated():
    assert sweep_numbers().tolist() == [0.065, 0.052, 0.058, 0.0, 0.0, 0.111, 0.033, 0.052, 0.065, 0.0, 0.0, 0.114]
    assert Z1_GRIPPER["open"] == {"jointGripper": -0.88}
    assert Z1_GRIPPER["fingertip"] == [0.0, 0.0, 0.140]
    assert Z1_GRIPPER["bbox"] == [[-0.05, -0.041, 0.0], [0.05, 0.041, 0.149]]


def test_names_and_unions_are_checked():
    assert split_generator_name("union:obb_sweep+diffusion") == ("obb_sweep", "diffusion")
    with raises(InvalidValueError, "unknown_generator"):
        split_generator_name("union:obb_sweep+x")
    for single in ("union:obb_sweep", "union:obb_sweep+obb_sweep"):
        with raises(InvalidValueError, "union_members"):
            split_generator_name(single)


def test_the_kind_of_weights_gives_the_generator(tmp_path):
    assert generator_for(tmp_path) == "graspgenx"
    assert generator_for(tmp_path / "graspgen_franka_panda.yml") == "graspgen"
    assert generator_for(tmp_path / "mine.npz") == "diffusion"
    with raises(InvalidValueError, "unknown_weights"):
        generator_for(tmp_path / "yolov8n.pt")


def test_weights_go_to_the_member_that_needs_them(tmp_path):
    options = GeneratorOptions(weights=tmp_path / "x.yml")
    with raises(InvalidValueError, "generator_weights"):
        make_generator("union:antipodal+obb_sweep", options)
    with raises(InvalidValueError, "generator_weights"):
        make_generator("union:graspgen+graspgenx", options)
    with raises(WeightsError, "weights_missing"):
        make_generator("diffusion", options)
    with raises(GeneratorError, "no_weights"):
        make_generator("union:obb_sweep+graspgen")
    with raises(InvalidValueError, "generator_process"):
        GeneratorOptions(process="other")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["graspgen", "graspgenx"])
def test_a_missing_checkpoint_and_a_missing_python_are_reported(name: str, tmp_path):
    with raises(GeneratorError, "checkpoint_missing"):
        make_nvidia_generator(name, tmp_path / "none.yml", own_process=False)
    with raises(GeneratorError, "python_missing") as caught:
        make_nvidia_generator(name, tmp_path / "none.yml", own_process=True, python=tmp_path / "python")
    assert f"make_generator_env {name}" in str(caught.value)


def test_the_licence_is_logged_once(caplog, tmp_path):
    from models.nvidia.graspgen import log_licence_once

    log_licence_once.cache_clear()
    for _ in range(2):
        with raises(GeneratorError, "checkpoint_missing"):
            make_nvidia_generator("graspgen", tmp_path / "none.yml", own_process=False)
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "no commercial use" in caplog.text

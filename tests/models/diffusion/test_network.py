"""The networks' inputs and outputs, their training step, and their weights on disk."""

import numpy as np
import pytest
import torch

from models.diffusion.cloud import N_POINTS, find_view_frame, prepare_cloud
from models.diffusion.network import Denoiser, Discriminator, decode_grasps, encode_grasps
from models.diffusion.training.data import augment, load_shards
from models.diffusion.training.labelled_samples import LabellingConfig, label_samples
from models.diffusion.training.labels import GRIPPERS, check_grasps
from models.diffusion.training.training import (
    TrainingConfig,
    calibrate_discriminator,
    train_discriminator,
    train_generator,
)
from models.diffusion.weights import WeightsError, load_weights, save_weights
from scripts.train.make_grasp_dataset import make_shard

HAND = GRIPPERS["agnostic"]


def front_of_a_box(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (900, 3))


def turned(points: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    return points @ R.T, R


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards")
    np.savez(folder / "7.npz", allow_pickle=False, **make_shard(HAND, 7, n_shapes=4, n_views=2))
    return load_shards(folder)


def test_the_view_frame_turns_with_the_camera():
    points = front_of_a_box(np.random.default_rng(0))
    T = find_view_frame(points)
    moved, R = turned(points, 1)
    assert find_view_frame(moved)[:3, :3] == pytest.approx(R @ T[:3, :3], abs=1e-6)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[:3, 2] @ T[:3, 3] == pytest.approx(np.linalg.norm(T[:3, 3]))


@pytest.mark.parametrize("count", [30, 400, 5000])
def test_any_number_of_points_becomes_the_networks_number(count):
    rng = np.random.default_rng(0)
    cloud = prepare_cloud(rng.uniform([-0.03, -0.08, 0.39], [0.05, 0.08, 0.40], (count, 3)), rng)
    assert cloud.points.shape == cloud.normals.shape == (N_POINTS, 3)
    assert np.linalg.norm(cloud.normals, axis=1) == pytest.approx(1.0)


def test_grasps_survive_the_way_into_coordinates_and_back():
    T = np.tile(np.eye(4), (20, 1, 1))
    for k in range(20):
        T[k, :3, :3] = turned(np.zeros((1, 3)), k)[1]
        T[k, :3, 3] = np.random.default_rng(k).normal(size=3) * 0.05
    widths = torch.linspace(0.01, 0.1, 20, dtype=torch.float64)
    back, widths_back = decode_grasps(encode_grasps(torch.from_numpy(T), widths))
    assert back.numpy() == pytest.approx(T, abs=1e-9)
    assert widths_back.numpy() == pytest.approx(widths.numpy())


def test_crooked_coordinates_still_decode_to_rotations():
    R = decode_grasps(torch.randn(50, 10, dtype=torch.float64))[0][:, :3, :3].numpy()
    assert R @ R.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (50, 1, 1)), abs=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("symmetric", [True, False])
def test_augmenting_keeps_grasps_where_they_are_on_the_cloud(symmetric):
    torch.manual_seed(0)
    cloud = torch.randn(3, N_POINTS, 6) * 0.04
    T = torch.eye(4).repeat(3, 5, 1, 1)
    T[..., :3, 3] = cloud[:, :5, :3]
    moved_cloud, moved = augment(cloud, encode_grasps(T, torch.full((3, 5), 0.05)), symmetric)
    positions = decode_grasps(moved)[0][..., :3, 3]
    assert (positions - moved_cloud[:, :5, :3]).norm(dim=-1).max() < 0.003  # the points' own jitter


def test_only_a_hand_that_is_its_own_mirror_image_is_turned_over():
    torch.manual_seed(0)
    T = torch.eye(4).repeat(40, 6, 1, 1)
    grasps = encode_grasps(T, torch.full((40, 6), 0.05))
    cloud = torch.zeros(40, N_POINTS, 6)
    for symmetric in (True, False):
        closing = augment(cloud, grasps, symmetric)[1][..., 6:9]
        same_way = (closing * closing[:, :1]).sum(-1) > 0.0  # within a cloud all were alike before
        assert same_way.all() != symmetric


def test_ground_truth_in_the_view_frame_still_holds_on_the_true_object(data):
    T, widths = data.draw_grasps(np.arange(8), 30, np.random.default_rng(0))
    for view in range(8):
        T_object = np.linalg.inv(data.T_view_object[view].astype(np.float64)) @ T[view]
        check = check_grasps(data.solid(view), T_object, HAND)
        assert check.valid.mean() > 0.95
        assert np.nanmedian(np.abs(check.widths_m - widths[view])) < 1e-3


def test_grasps_from_the_cameras_side_are_drawn_more_often(data):
    T, _ = data.draw_grasps(np.arange(8), 400, np.random.default_rng(0))
    everywhere = (data.T_view_object[:, None] @ data.grasps[data.shape])[:, :, 2, 2]
    assert T[:, :, 2, 2].mean() > everywhere.mean() + 0.05


def test_training_lowers_the_loss_and_resumes_where_it_stopped(data, tmp_path):
    torch.set_num_threads(1)
    config = TrainingConfig(generator_iterations=20, views_per_batch=6, grasps_per_view=24)
    losses: list[float] = []
    whole = train_generator(data, config, tmp_path / "whole.pt", lambda _, loss: losses.append(loss))
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:3])

    class StoppedError(Exception):
        pass

    def stop(iteration: int, _: float) -> None:
        raise StoppedError

    again = train_generator(data, config, tmp_path / "whole.pt", stop)  # nothing is left to do
    for a, b in zip(whole.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)


def judged_by(generator: Denoiser, data, folder, seen=lambda *_: None, **settings):
    config = LabellingConfig(**{"views": 8, "samples": 24, "perturbed": 24, "steps": 2} | settings)
    return label_samples(generator, data, HAND, config=config, seed=0, folder=folder / "labelled", progress=seen)


def test_judged_samples_are_kept_for_the_generator_that_made_them(data, tmp_path, monkeypatch):
    first, other = Denoiser().eval(), Denoiser().eval()
    labelled = judged_by(first, data, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("models.diffusion.training.labelled_samples.check_grasps", None)  # nothing may be judged anew
        again = judged_by(first, data, tmp_path)
    assert torch.equal(labelled.grasps, again.grasps) and torch.equal(labelled.valid, again.valid)
    assert not torch.equal(labelled.grasps[:, :24], judged_by(other, data, tmp_path).grasps[:, :24])


def test_what_is_lost_when_shaken_counts_as_invalid(data, tmp_path, monkeypatch):
    generator = Denoiser().eval()
    unshaken = judged_by(generator, data, tmp_path / "none", simulated_fraction=0.0)
    monkeypatch.setattr(
        "models.diffusion.training.labelled_samples.shake_grasps", lambda _, T, *__: np.arange(len(T)) % 2 == 0
    )
    labelled = judged_by(generator, data, tmp_path / "all", simulated_fraction=1.0)
    assert labelled.simulated == unshaken.valid.sum() > 0
    assert 0 < labelled.lost == unshaken.valid.sum() - labelled.valid.sum()
    assert unshaken.simulated == unshaken.lost == 0


def test_calibration_takes_back_what_a_discriminator_is_too_sure_of(data, tmp_path):
    generator = Denoiser().eval()
    labelled = judged_by(generator, data, tmp_path, simulated_fraction=0.0)
    sure, modest = Discriminator().eval(), Discriminator().eval()
    sure.head.leave[-1].bias.data.fill_(4.0)
    modest.load_state_dict(sure.state_dict())
    scale, offset = calibrate_discriminator(modest, data, labelled)
    cloud = torch.from_numpy(data.clouds[labelled.views].astype(np.float32))
    before, after = (float(torch.sigmoid(d(cloud, labelled.grasps)).mean()) for d in (sure, modest))
    assert after == pytest.approx(float(labelled.valid.mean()), abs=0.02)
    assert before > after + 0.2
    assert (scale, offset) != (1.0, 0.0)


def test_the_discriminator_learns_from_the_generators_own_judged_samples(data, tmp_path):
    torch.set_num_threads(1)
    config = TrainingConfig(discriminator_iterations=20)
    generator = Denoiser().eval()
    labelled = judged_by(generator, data, tmp_path)
    assert labelled.valid[:, 24:].mean() > labelled.valid[:, :24].mean()  # near ground truth against an untrained net
    losses: list[float] = []
    train_discriminator(
        generator,
        data,
        labelled,
        config=config,
        checkpoint=tmp_path / "d.pt",
        progress=lambda _, loss: losses.append(loss),
    )
    assert np.mean(losses[-4:]) < np.mean(losses[:2])


def test_weights_come_back_as_they_were_saved(tmp_path):
    generator, discriminator = Denoiser(), Discriminator()
    save_weights(tmp_path / "w.npz", generator, discriminator)
    loaded, judge = load_weights(tmp_path / "w.npz")
    for mine, theirs in ((generator, loaded), (discriminator, judge)):
        for a, b in zip(mine.state_dict().values(), theirs.state_dict().values(), strict=True):
            assert torch.allclose(a, b, atol=1e-3)


def test_a_damaged_weights_file_is_refused(tmp_path):
    path = tmp_path / "w.npz"
    save_weights(path, Denoiser(), Discriminator())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(WeightsError, match="damaged"):
        load_weights(path)


def test_missing_weights_say_how_to_get_them(tmp_path):
    with pytest.raises(WeightsError, match="train_graspgen"):
        load_weights(tmp_path / "w.npz")


def test_weights_of_another_network_are_refused(tmp_path):
    save_weights(tmp_path / "w.npz", Discriminator(), Discriminator())  # pyright: ignore[reportArgumentType]
    with pytest.raises(WeightsError, match="another network"):
        load_weights(tmp_path / "w.npz")

"""The diffusion networks' weights on disk."""

import pytest
import torch

from models.diffusion.network import Denoiser, Discriminator, load_weights, save_weights, weights_path
from models.weights_file import WeightsError, verify_sha256
from tests.support.errors import raises


@pytest.mark.integration
def test_weights_round_trip_through_the_file(tmp_path):
    generator, discriminator = Denoiser(), Discriminator()
    save_weights(tmp_path / "w.npz", generator, discriminator)
    loaded, scorer = load_weights(tmp_path / "w.npz")
    for saved, read in ((generator, loaded), (discriminator, scorer)):
        for a, b in zip(saved.state_dict().values(), read.state_dict().values(), strict=True):
            assert torch.allclose(a, b, atol=1e-3)


def test_a_damaged_weights_file_is_rejected(tmp_path):
    path = tmp_path / "w.npz"
    save_weights(path, Denoiser(), Discriminator())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with raises(WeightsError, "weights_damaged"):
        load_weights(path)


def test_missing_weights_are_reported_with_the_command_that_makes_them(tmp_path):
    with raises(WeightsError, "weights_missing") as caught:
        load_weights(tmp_path / "w.npz")
    assert "train_diffusion" in str(caught.value)


def test_weights_of_another_network_are_rejected(tmp_path):
    save_weights(tmp_path / "w.npz", Discriminator(), Discriminator())  # pyright: ignore[reportArgumentType]
    with raises(WeightsError, "weights_other_network"):
        load_weights(tmp_path / "w.npz")


@pytest.mark.parametrize(("gripper", "name"), [("agnostic", "diffusion.npz"), ("z1", "diffusion_z1.npz")])
def test_shipped_weights_are_complete(gripper, name):
    assert weights_path(gripper).name == name
    assert len(verify_sha256(weights_path(gripper), "git checkout")) == 64

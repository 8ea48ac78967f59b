"""The detector's weights: a round trip, and errors for other files."""

import numpy as np
import pytest
import torch

from models.detector.weights import CLASSES, load_detector, new_network, save_detector
from models.weights_file import WeightsError, write_arrays
from tests.support.errors import raises


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    torch.manual_seed(0)
    network = new_network(3)
    path = tmp_path_factory.mktemp("weights") / "detector.npz"
    save_detector(path, network, {0: "bottle", 1: "cylinder", 2: "box"}, (96, 128))
    return network, path


@pytest.mark.integration
def test_a_saved_detector_gives_the_same_outputs(saved):
    network, path = saved
    loaded = load_detector(path)
    assert (loaded.names, loaded.input_hw) == (CLASSES, (96, 128))
    assert not loaded.network.training
    image = torch.rand(1, 3, 96, 128)
    with torch.inference_mode():
        (was, was_protos), (now, now_protos) = network(image)[0], loaded.network(image)[0]
    assert torch.allclose(was[:, :4], now[:, :4], atol=0.5)  # [px]
    assert torch.allclose(was[:, 4:7], now[:, 4:7], atol=1e-3)
    assert torch.allclose(was_protos, now_protos, atol=1e-2)


def test_a_saved_detector_is_small(saved):
    assert saved[1].stat().st_size < 7.2e6


@pytest.mark.integration
def test_the_wrong_number_of_names_writes_nothing(saved, tmp_path):
    with raises(WeightsError, "weights_other_network"):
        save_detector(tmp_path / "d.npz", saved[0], ("bottle", "box"))
    assert not list(tmp_path.iterdir())


@pytest.mark.integration
def test_a_fused_model_writes_nothing(tmp_path):
    with raises(WeightsError, "weights_other_network"):
        save_detector(tmp_path / "d.npz", new_network(3).fuse(verbose=False))
    assert not list(tmp_path.iterdir())


@pytest.mark.integration
def test_a_model_that_is_not_finite_writes_nothing(tmp_path):
    network = new_network(3)
    with torch.no_grad():
        next(network.parameters())[0, 0, 0, 0] = 1e6  # too large for half precision
    with raises(WeightsError, "weights_not_finite") as caught:
        save_detector(tmp_path / "d.npz", network)
    assert "network/model.0.conv.weight" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_file_of_another_kind_is_rejected(tmp_path):
    path = tmp_path / "d.npz"
    write_arrays(path, {"names": np.array(["a"])})
    with raises(WeightsError, "weights_incomplete"):
        load_detector(path)
    write_arrays(path, {"architecture": np.array("yolo9000"), "names": np.array(["a"]), "input_hw": np.array([1, 1])})
    with raises(WeightsError, "weights_other_network"):
        load_detector(path)


def test_a_missing_detector_names_the_command_that_trains_it(tmp_path):
    with raises(WeightsError, "weights_missing") as caught:
        load_detector(tmp_path / "d.npz")
    assert "train_detector" in str(caught.value)

"""Training of the networks, and the labelled samples of the generator."""

import numpy as np
import pytest
import torch

from models.diffusion.network import Denoiser, Discriminator
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labelled_samples import LabelledSamples, LabellingConfig, label_samples
from models.diffusion.training.training import (
    TrainingConfig,
    calibrate_discriminator,
    train_discriminator,
    train_generator,
)

GRIPPER = GRIPPERS["agnostic"]


@pytest.mark.integration
def test_training_lowers_the_loss_and_resumes(data, tmp_path):
    torch.set_num_threads(1)
    config = TrainingConfig(generator_iterations=15, views_per_batch=4, grasps_per_view=24)
    losses: list[float] = []
    whole = train_generator(data, config, tmp_path / "whole.pt", lambda _, loss: losses.append(loss))
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:3])

    class StoppedError(Exception):
        pass

    def stop(iteration: int, _: float) -> None:
        raise StoppedError

    again = train_generator(data, config, tmp_path / "whole.pt", stop)  # nothing remains
    for a, b in zip(whole.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)


def label(generator: Denoiser, data, folder, **settings) -> LabelledSamples:
    config = LabellingConfig(**{"views": 8, "samples": 24, "perturbed": 24, "steps": 2} | settings)
    return label_samples(
        generator, data, GRIPPER, config=config, seed=0, folder=folder / "labelled", progress=lambda *_: None
    )


@pytest.mark.integration
def test_labelled_samples_are_cached_for_their_generator(data, tmp_path, monkeypatch):
    first, other = Denoiser().eval(), Denoiser().eval()
    labelled = label(first, data, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("models.diffusion.training.labelled_samples.check_grasps", None)  # no label is made again
        again = label(first, data, tmp_path)
    assert torch.equal(labelled.grasps, again.grasps) and torch.equal(labelled.valid, again.valid)
    assert not torch.equal(labelled.grasps[:, :24], label(other, data, tmp_path).grasps[:, :24])


@pytest.mark.integration
def test_a_grasp_lost_in_simulation_counts_as_invalid(data, tmp_path, monkeypatch):
    generator = Denoiser().eval()
    without_simulation = label(generator, data, tmp_path / "none", simulated_fraction=0.0)
    monkeypatch.setattr(
        "models.diffusion.training.labelled_samples.simulate_grasps", lambda _, T, *__: np.arange(len(T)) % 2 == 0
    )
    labelled = label(generator, data, tmp_path / "all", simulated_fraction=1.0)
    assert labelled.simulated == without_simulation.valid.sum() > 0
    assert 0 < labelled.lost == without_simulation.valid.sum() - labelled.valid.sum()
    assert without_simulation.simulated == without_simulation.lost == 0


@pytest.mark.integration
def test_calibration_corrects_an_overconfident_discriminator(data, tmp_path):
    generator = Denoiser().eval()
    labelled = label(generator, data, tmp_path, simulated_fraction=0.0)
    overconfident, calibrated = Discriminator().eval(), Discriminator().eval()
    overconfident.head.leave[-1].bias.data.fill_(4.0)
    calibrated.load_state_dict(overconfident.state_dict())
    scale, offset = calibrate_discriminator(calibrated, data, labelled)
    cloud = torch.from_numpy(data.clouds[labelled.views].astype(np.float32))
    with torch.inference_mode():
        before, after = (float(torch.sigmoid(d(cloud, labelled.grasps)).mean()) for d in (overconfident, calibrated))
    assert after == pytest.approx(float(labelled.valid.mean()), abs=0.02)
    assert before > after + 0.2
    assert (scale, offset) != (1.0, 0.0)


@pytest.mark.integration
def test_the_discriminator_learns_from_labelled_samples(data, tmp_path):
    torch.set_num_threads(1)
    config = TrainingConfig(discriminator_iterations=12)
    generator = Denoiser().eval()
    labelled = label(generator, data, tmp_path)
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

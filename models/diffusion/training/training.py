"""Training of the generator, and of the discriminator on labelled samples of the generator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor, nn
from torch.nn import functional as F

from hal.base.files import atomic_path
from models.diffusion.network import Denoiser, Discriminator, encode_grasps
from models.diffusion.training.data import GraspData, augment
from models.diffusion.training.labelled_samples import LabelledSamples, LabellingConfig, ProgressCallback
from models.torch_threads import has_bfloat16

ModuleT = TypeVar("ModuleT", bound=nn.Module)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """Iterations, rates and batches, as written into the weights' recipe."""

    generator_iterations: int = 15000
    generator_rate: float = 1.5e-3
    views_per_batch: int = 20
    grasps_per_view: int = 72
    discriminator_iterations: int = 4000
    discriminator_rate: float = 1.0e-3
    labelling: LabellingConfig = field(default_factory=LabellingConfig)
    seed: int = 0


def train_generator(
    data: GraspData,
    config: TrainingConfig,
    checkpoint: Path,
    progress: ProgressCallback,
    *,
    symmetric: bool = True,
    start_from: Denoiser | None = None,
) -> Denoiser:
    """Return the generator, its weights averaged over the last iterations; resumes from `checkpoint` if it exists.

    Args:
        data: views and ground-truth grasps.
        config: iterations, rates and batches.
        checkpoint: file to resume from and to write.
        progress: called at each iteration.
        symmetric: whether the gripper is its own mirror image.
        start_from: generator of another gripper, to be tuned for this one.
    """
    model = _seeded(Denoiser, config.seed)
    if start_from is not None:
        model.load_state_dict(start_from.state_dict())
    average = _seeded(Denoiser, config.seed)
    average.load_state_dict(model.state_dict())
    n_views = len(data.clouds)

    def loss_at(rng: np.random.Generator) -> Tensor:
        views = rng.integers(0, n_views, config.views_per_batch)
        T, widths = data.draw_grasps(views, config.grasps_per_view, rng)
        grasps = encode_grasps(torch.from_numpy(T), torch.from_numpy(widths))
        cloud = torch.from_numpy(data.clouds[views].astype(np.float32))
        cloud, grasps = augment(cloud, grasps, symmetric)
        return model.loss(cloud, grasps)

    for iteration, loss in _descend(
        model,
        average,
        loss_at=loss_at,
        rate=config.generator_rate,
        iterations=config.generator_iterations,
        seed=config.seed,
        checkpoint=checkpoint,
    ):
        progress(iteration, loss)
    return average.eval()


def train_discriminator(
    generator: Denoiser,
    data: GraspData,
    labelled: LabelledSamples,
    *,
    config: TrainingConfig,
    checkpoint: Path,
    progress: ProgressCallback,
    symmetric: bool = True,
) -> Discriminator:
    """Return the discriminator; its encoder starts from the generator's. `symmetric` as for that."""
    model = _seeded(Discriminator, config.seed)
    model.encoder.load_state_dict(generator.encoder.state_dict())
    average = _seeded(Discriminator, config.seed)
    average.load_state_dict(model.state_dict())

    def loss_at(rng: np.random.Generator) -> Tensor:
        rows = rng.integers(0, len(labelled.views), 16)
        cloud = torch.from_numpy(data.clouds[labelled.views[rows]].astype(np.float32))
        cloud, grasps = augment(cloud, labelled.grasps[rows], symmetric)
        return F.binary_cross_entropy_with_logits(model(cloud, grasps).float(), labelled.valid[rows])

    for iteration, loss in _descend(
        model,
        average,
        loss_at=loss_at,
        rate=config.discriminator_rate,
        iterations=config.discriminator_iterations,
        seed=config.seed,
        checkpoint=checkpoint,
    ):
        progress(iteration, loss)
    return average.eval()


def calibrate_discriminator(
    discriminator: Discriminator, data: GraspData, labelled: LabelledSamples
) -> tuple[float, float]:
    """Set scale and offset of the discriminator's logits so that scores are success ratios; return both.

    Args:
        discriminator: changed in its last layer.
        data: shapes outside of the training data.
        labelled: samples on those.
    """
    with torch.inference_mode():
        logits = torch.cat(
            [
                discriminator(torch.from_numpy(data.clouds[[view]].astype(np.float32)), grasps[None])
                for view, grasps in zip(labelled.views, labelled.grasps, strict=True)
            ]
        )
    x, y = logits.flatten().double().numpy(), labelled.valid.flatten().double().numpy()

    def cross_entropy(parameters: np.ndarray) -> float:
        z = parameters[0] * x + parameters[1]
        return float(np.mean(np.logaddexp(0.0, z) - y * z))

    scale, offset = (float(p) for p in minimize(cross_entropy, [1.0, 0.0], method="Nelder-Mead").x)
    last = discriminator.head.leave[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(scale)
        last.bias.mul_(scale).add_(offset)
    return scale, offset


def _seeded(make: Callable[[], ModuleT], seed: int) -> ModuleT:
    torch.manual_seed(seed)
    return make()


def _descend(
    model: nn.Module,
    average: nn.Module,
    *,
    loss_at: Callable[[np.random.Generator], Tensor],
    rate: float,
    iterations: int,
    seed: int,
    checkpoint: Path,
) -> Iterator[tuple[int, float]]:
    """Yield (iteration, loss) while AdamW runs down a cosine; `average` follows `model`.

    In bfloat16 where the processor has it.
    """
    optimiser = torch.optim.AdamW(model.parameters(), lr=rate, betas=(0.9, 0.98), weight_decay=0.01)
    start = 0
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        model.load_state_dict(saved["model"])
        average.load_state_dict(saved["average"])
        optimiser.load_state_dict(saved["optimiser"])
        start = int(saved["iteration"])
    for iteration in range(start, iterations):
        # Seeds for each iteration: a resumed run draws the same numbers as an uninterrupted one.
        rng = np.random.default_rng((seed, iteration))
        # More than any number of iterations, so that two seeds share none
        torch.manual_seed(seed * 1_000_003 + iteration)
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, (iteration + 1) / 100) * _cosine(iteration / iterations)
        with torch.autocast("cpu", torch.bfloat16, enabled=has_bfloat16()):
            loss = loss_at(rng)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        # A short memory at first, so that the random weights of the start are forgotten
        _follow(average, model, min(0.998, (iteration + 1) / (iteration + 50)))
        if (iteration + 1) % 250 == 0 or iteration + 1 == iterations:
            _save(checkpoint, model, average, optimiser, iteration + 1)
        yield iteration + 1, loss.item()


def _cosine(fraction: float) -> float:
    return 0.5 * (1.0 + math.cos(math.pi * fraction)) + 0.01


@torch.no_grad()
def _follow(average: nn.Module, model: nn.Module, keep: float) -> None:
    for a, b in zip(average.parameters(), model.parameters(), strict=True):
        a.lerp_(b, 1.0 - keep)


def _save(path: Path, model: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer, iteration: int) -> None:
    state = {"model": model.state_dict(), "average": average.state_dict(), "optimiser": optimiser.state_dict()}
    with atomic_path(path) as partial, partial.open("wb") as file:
        torch.save(state | {"iteration": iteration}, file)

"""Trains the generator, lets the exact check judge its samples, and trains the discriminator on those."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.graspgen.data import GraspData, augment
from models.graspgen.labels import GripperSpec, check_grasps
from models.graspgen.network import N_COORDINATES, Denoiser, Discriminator, decode_grasps, encode_grasps

Network = TypeVar("Network", bound=nn.Module)
Progress = Callable[[int, float], None]
"""Called with the iteration and the loss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """How long and how fast; the recipe that is written beside the weights."""

    generator_iterations: int = 15000
    generator_rate: float = 1.5e-3
    views_per_batch: int = 20
    grasps_per_view: int = 72
    discriminator_iterations: int = 5000
    discriminator_rate: float = 1.0e-3
    judged_views: int = 10000
    """Views whose samples the exact check labels."""
    samples_per_view: int = 64
    """Of the generator's own."""
    perturbed_per_view: int = 32
    """Ground truth knocked aside by up to 20 mm and some 20°."""
    steps: int = 8
    """Denoising steps with which those samples are made."""
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JudgedSamples:
    """Grasps with the exact check's verdicts."""

    views: np.ndarray
    """(J,) indices of the views."""
    grasps: Tensor
    """(J, K, 10)."""
    valid: Tensor
    """(J, K) 1.0 where the check passed."""


def train_generator(data: GraspData, config: TrainingConfig, checkpoint: Path, progress: Progress) -> Denoiser:
    """Return the generator, its weights averaged over the last iterations; goes on from `checkpoint` if it is there."""
    model = _seeded(Denoiser, config.seed)
    average = _seeded(Denoiser, config.seed)
    n_views = len(data.clouds)

    def loss_at(rng: np.random.Generator) -> Tensor:
        views = rng.integers(0, n_views, config.views_per_batch)
        T, widths = data.draw_grasps(views, config.grasps_per_view, rng)
        grasps = encode_grasps(torch.from_numpy(T), torch.from_numpy(widths))
        cloud, grasps = augment(torch.from_numpy(data.clouds[views].astype(np.float32)), grasps)
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


def judge_samples(
    generator: Denoiser, data: GraspData, gripper: GripperSpec, config: TrainingConfig, progress: Progress
) -> JudgedSamples:
    """Return the generator's own samples and perturbed ground truth with the exact check's verdicts."""
    rng = np.random.default_rng(config.seed + 1)
    torch.manual_seed(config.seed + 1)
    views = rng.permutation(len(data.clouds))[: config.judged_views]
    grasps, valid = [], []
    for start in range(0, len(views), 16):
        part = views[start : start + 16]
        cloud = torch.from_numpy(data.clouds[part].astype(np.float32))
        noise = torch.randn(len(part), config.samples_per_view, N_COORDINATES)
        with torch.autocast("cpu", torch.bfloat16):
            own = generator.sample(cloud, noise, config.steps)
        T, widths = data.draw_grasps(part, config.perturbed_per_view, rng)
        v = torch.cat([own, _perturbed(encode_grasps(torch.from_numpy(T), torch.from_numpy(widths)))], dim=1)
        T_view, _ = decode_grasps(v.double())
        for row, view in enumerate(part):
            T_object = np.linalg.inv(data.T_view_object[view].astype(np.float64)) @ T_view[row].numpy()
            valid.append(check_grasps(data.solid(view), T_object, gripper).valid)
        grasps.append(v)
        progress(start + len(part), float(np.mean(valid[-len(part) :])))
    return JudgedSamples(
        views=views, grasps=torch.cat(grasps), valid=torch.from_numpy(np.array(valid, dtype=np.float32))
    )


def train_discriminator(
    generator: Denoiser,
    data: GraspData,
    judged: JudgedSamples,
    *,
    config: TrainingConfig,
    checkpoint: Path,
    progress: Progress,
) -> Discriminator:
    """Return the discriminator; its encoder starts from the generator's."""
    model = _seeded(Discriminator, config.seed)
    model.encoder.load_state_dict(generator.encoder.state_dict())
    average = _seeded(Discriminator, config.seed)
    average.load_state_dict(model.state_dict())

    def loss_at(rng: np.random.Generator) -> Tensor:
        rows = rng.integers(0, len(judged.views), 16)
        cloud = torch.from_numpy(data.clouds[judged.views[rows]].astype(np.float32))
        cloud, grasps = augment(cloud, judged.grasps[rows])
        return F.binary_cross_entropy_with_logits(model(cloud, grasps).float(), judged.valid[rows])

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


def _seeded(make: Callable[[], Network], seed: int) -> Network:
    torch.manual_seed(seed)
    return make()


def _perturbed(v: Tensor) -> Tensor:
    """Return grasps (B, K, 10) each knocked aside by its own random amount."""
    amount = torch.rand(*v.shape[:2], 1)
    scale = torch.tensor([0.4] * 3 + [0.35] * 6 + [0.2])
    return v + amount * scale * torch.randn_like(v)


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
    """Yield (iteration, loss) while AdamW runs down a cosine; `average` follows `model`. bfloat16 where it helps."""
    optimiser = torch.optim.AdamW(model.parameters(), lr=rate, betas=(0.9, 0.98), weight_decay=0.01)
    start = 0
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        model.load_state_dict(saved["model"])
        average.load_state_dict(saved["average"])
        optimiser.load_state_dict(saved["optimiser"])
        start = int(saved["iteration"])
    for iteration in range(start, iterations):
        # Seeds of each iteration's own: a resumed run draws what an unbroken one would.
        rng = np.random.default_rng((seed, iteration))
        torch.manual_seed(seed * 1_000_003 + iteration)
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, (iteration + 1) / 100) * _cosine(iteration / iterations)
        with torch.autocast("cpu", torch.bfloat16):
            loss = loss_at(rng)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
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
    partial = path.with_suffix(".partial")
    state = {"model": model.state_dict(), "average": average.state_dict(), "optimiser": optimiser.state_dict()}
    torch.save(state | {"iteration": iteration}, partial)
    partial.replace(path)

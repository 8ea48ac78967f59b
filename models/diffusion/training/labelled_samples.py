"""Labelled samples of the generator, the training data of its discriminator (on-generator training)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hal.base.files import atomic_path
from models.diffusion.network import N_COORDINATES, Denoiser, decode_grasps, encode_grasps
from models.diffusion.training.data import GraspData
from models.diffusion.training.dynamics_test import simulate_grasps
from models.diffusion.training.grippers import AnyGripper, ParallelGripperSpec
from models.diffusion.training.labels import check_grasps
from models.weights_file import has_bfloat16

ProgressCallback = Callable[[int, float], None]
"""Called with the number of items done and the current value (a loss, or a ratio)."""
_BATCH = 16
_CHUNK = 10 * _BATCH  # views in a file


@dataclass(frozen=True, slots=True, kw_only=True)
class LabellingConfig:
    """Numbers of labelled grasps, and their labels."""

    views: int = 10000
    """Views whose samples are labelled."""
    samples: int = 64
    """Samples of the generator on each."""
    perturbed: int = 32
    """Ground-truth grasps perturbed by up to 20 mm and some 20°, on each."""
    steps: int = 5
    """Denoising steps of the samples."""
    simulated_fraction: float = 0.01
    """Ratio of the valid grasps that are also simulated; those lost there count as invalid."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelledSamples:
    """Grasps with their labels."""

    views: np.ndarray
    """(J,) indices of the views."""
    grasps: Tensor
    """(J, K, 10)."""
    valid: Tensor
    """(J, K) 1.0 where the exact check passed, and the dynamics test of the simulated ones."""
    simulated: int
    """Number of grasps that were simulated."""
    lost: int
    """Number of those that did not hold."""


def label_samples(
    generator: Denoiser,
    data: GraspData,
    gripper: AnyGripper,
    *,
    config: LabellingConfig,
    seed: int,
    folder: Path,
    progress: ProgressCallback,
) -> LabelledSamples:
    """Return the generator's samples and perturbed ground truth, labelled by exact check and dynamics test.

    Chunks are kept in `folder`; those of the same generator and configuration are reused.
    """
    folder.mkdir(parents=True, exist_ok=True)
    digest = _digest(generator, config)
    views = np.random.default_rng((seed, 1)).permutation(len(data.clouds))[: config.views]
    chunks = []
    for start in range(0, len(views), _CHUNK):
        path = folder / f"{start:05d}.npz"
        chunk = _load(path, digest)
        if chunk is None:
            chunk = _label_chunk(generator, data, gripper, views[start : start + _CHUNK], config, (seed, 2, start))
            with atomic_path(path) as partial, partial.open("wb") as file:
                np.savez(file, allow_pickle=False, digest=np.array(digest), **chunk)
        chunks.append(chunk)
        progress(start + len(chunk["valid"]), float(chunk["valid"].mean()))
    joined = {key: np.concatenate([chunk[key] for chunk in chunks]) for key in chunks[0]}
    return LabelledSamples(
        views=views,
        grasps=torch.from_numpy(joined["grasps"]),
        valid=torch.from_numpy(joined["valid"].astype(np.float32)),
        simulated=int(joined["simulated"].sum()),
        lost=int(joined["lost"].sum()),
    )


def _label_chunk(  # noqa: PLR0917
    generator: Denoiser,
    data: GraspData,
    gripper: AnyGripper,
    views: np.ndarray,
    config: LabellingConfig,
    seed: tuple[int, ...],
) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    torch.manual_seed(int(rng.integers(2**31)))
    rows: dict[str, list[np.ndarray]] = {"grasps": [], "valid": [], "simulated": [], "lost": []}
    for start in range(0, len(views), _BATCH):
        part = views[start : start + _BATCH]
        cloud = torch.from_numpy(data.clouds[part].astype(np.float32))
        with torch.autocast("cpu", torch.bfloat16, enabled=has_bfloat16()):
            own = generator.sample(cloud, torch.randn(len(part), config.samples, N_COORDINATES), config.steps)
        T, widths = data.draw_grasps(part, config.perturbed, rng)
        v = torch.cat([own.float(), _perturb(encode_grasps(torch.from_numpy(T), torch.from_numpy(widths)))], dim=1)
        T_view, widths_view = (a.numpy() for a in decode_grasps(v.double()))
        for row, view in enumerate(part):
            T_object = np.linalg.inv(data.T_view_object[view].astype(np.float64)) @ T_view[row]
            solid = data.solid(int(view))
            check = check_grasps(solid, T_object, gripper, widths_view[row])
            simulated = check.valid & (rng.random(len(T_object)) < config.simulated_fraction)
            lost = np.zeros_like(simulated)
            if isinstance(gripper, ParallelGripperSpec):  # the dynamics test models parallel fingers only
                lost[simulated] = ~simulate_grasps(solid, T_object[simulated], check[simulated], gripper)
                rows["simulated"].append(simulated)
                rows["lost"].append(lost)
            rows["valid"].append(check.valid & ~lost)
        rows["grasps"].append(v.numpy())
    nothing = np.zeros((0, config.samples + config.perturbed), dtype=bool)
    return {
        "grasps": np.concatenate(rows["grasps"]),
        **{key: np.stack(rows[key]) if rows[key] else nothing for key in ("valid", "simulated", "lost")},
    }


def _load(path: Path, digest: str) -> dict[str, np.ndarray] | None:
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as file:
        if str(file["digest"]) != digest:
            return None
        return {key: file[key] for key in file.files if key != "digest"}


def _digest(generator: Denoiser, config: LabellingConfig) -> str:
    """Return the hash of a generator and its labelling configuration."""
    digest = hashlib.sha256(repr(config).encode())
    for value in generator.state_dict().values():
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def _perturb(v: Tensor) -> Tensor:
    """Return grasps (B, K, 10) each perturbed by its own random amount."""
    amount = torch.rand(*v.shape[:2], 1)
    # 0.4 of 5 cm is 20 mm, 0.35 rad is 20°, 0.2 of 3 cm is 6 mm of width
    scale = torch.tensor([0.4] * 3 + [0.35] * 6 + [0.2])
    return v + amount * scale * torch.randn_like(v)

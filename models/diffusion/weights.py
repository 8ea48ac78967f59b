"""Weights of the networks on disk: half-precision numbers in one file, and a file with its checksum."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from models.diffusion.network import Denoiser, Discriminator
from models.weights_file import WEIGHTS_FOLDER, WeightsError, read_arrays, write_arrays

ModuleT = TypeVar("ModuleT", bound=nn.Module)


def weights_path(gripper: str = "agnostic") -> Path:
    """Return the path of the shipped weights for a gripper: `diffusion.npz`, or `diffusion_<gripper>.npz`."""
    return WEIGHTS_FOLDER / ("diffusion.npz" if gripper == "agnostic" else f"diffusion_{gripper}.npz")


def save_weights(path: Path, generator: Denoiser, discriminator: Discriminator) -> str:
    """Write both networks to `path` and their SHA-256 next to it; return the latter."""
    arrays = {f"generator/{k}": v for k, v in generator.state_dict().items()}
    arrays |= {f"discriminator/{k}": v for k, v in discriminator.state_dict().items()}
    return write_arrays(path, {k: v.numpy().astype(np.float16) for k, v in arrays.items()})


def load_weights(path: Path) -> tuple[Denoiser, Discriminator]:
    """Return the generator and the discriminator of the file at `path`, in evaluation mode.

    Raises:
        WeightsError: the file or its checksum is missing, they differ, or the file is of another network.
    """
    halves = read_arrays(path, "python -m scripts.train.train_diffusion")
    # Half precision is for the file alone: the parameters were trained in single
    arrays = {key: torch.from_numpy(value.astype(np.float32)) for key, value in halves.items()}
    return _fill(Denoiser(), "generator/", arrays, path), _fill(Discriminator(), "discriminator/", arrays, path)


def _fill(network: ModuleT, prefix: str, arrays: dict[str, torch.Tensor], path: Path) -> ModuleT:
    state = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    try:
        network.load_state_dict(state)
    except RuntimeError as err:
        raise WeightsError(
            f"{path.name} holds another network than this version's: {err}", code="weights_other_network"
        ) from err
    return network.eval()

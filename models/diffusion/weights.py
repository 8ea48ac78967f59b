"""The networks' weights on disk: half-precision numbers in one file, and a checksum beside it."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from models.diffusion.network import Denoiser, Discriminator
from models.weights_file import WEIGHTS_FOLDER, WeightsError, read_arrays, write_arrays

Network = TypeVar("Network", bound=nn.Module)


def weights_path(gripper: str = "agnostic") -> Path:
    """Return where the weights for a hand lie."""
    return WEIGHTS_FOLDER / f"graspgen_{gripper}.npz"


def save_weights(path: Path, generator: Denoiser, discriminator: Discriminator) -> str:
    """Write both networks to `path` and their SHA-256 beside it; return the latter."""
    arrays = {f"generator/{k}": v for k, v in generator.state_dict().items()}
    arrays |= {f"discriminator/{k}": v for k, v in discriminator.state_dict().items()}
    return write_arrays(path, {k: v.numpy().astype(np.float16) for k, v in arrays.items()})


def load_weights(path: Path) -> tuple[Denoiser, Discriminator]:
    """Return the generator and the discriminator of the file at `path`, ready to sample.

    Raises:
        WeightsError: the file or its checksum is missing, they do not agree, or the file is of another network.
    """
    halves = read_arrays(path, "python -m scripts.train.train_graspgen")
    arrays = {key: torch.from_numpy(value.astype(np.float32)) for key, value in halves.items()}
    return _filled(Denoiser(), "generator/", arrays, path), _filled(Discriminator(), "discriminator/", arrays, path)


def _filled(network: Network, prefix: str, arrays: dict[str, torch.Tensor], path: Path) -> Network:
    state = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    try:
        network.load_state_dict(state)
    except RuntimeError as err:
        raise WeightsError(f"{path.name} holds another network than this version's: {err}") from err
    return network.eval()

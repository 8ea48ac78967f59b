"""The networks' weights on disk: half-precision numbers in one file, and a checksum beside it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from models.graspgen.network import Denoiser, Discriminator

Network = TypeVar("Network", bound=nn.Module)
WEIGHTS_FOLDER = Path(__file__).resolve().parent.parent / "weights"


class WeightsError(ValueError):
    """A weights file that is missing, damaged or of another network."""


def weights_path(gripper: str = "agnostic") -> Path:
    """Return where the weights for a hand lie."""
    return WEIGHTS_FOLDER / f"graspgen_{gripper}.npz"


def save_weights(path: Path, generator: Denoiser, discriminator: Discriminator) -> str:
    """Write both networks to `path` and their SHA-256 beside it; return the latter."""
    arrays = {f"generator/{k}": v for k, v in generator.state_dict().items()}
    arrays |= {f"discriminator/{k}": v for k, v in discriminator.state_dict().items()}
    np.savez(path, **{k: v.numpy().astype(np.float16) for k, v in arrays.items()})
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".sha256").write_text(f"{digest}  {path.name}\n")
    return digest


def load_weights(path: Path) -> tuple[Denoiser, Discriminator]:
    """Return the generator and the discriminator of the file at `path`, ready to sample.

    Raises:
        WeightsError: the file or its checksum is missing, they do not agree, or the file is of another network.
    """
    checksum = path.with_suffix(".sha256")
    for needed in (path, checksum):
        if not needed.is_file():
            raise WeightsError(f"{needed} is missing; restore it, or make it with `python -m scripts.train_graspgen`.")
    seen, wanted = hashlib.sha256(path.read_bytes()).hexdigest(), checksum.read_text().split()[0]
    if seen != wanted:
        raise WeightsError(
            f"{path.name} has SHA-256 {seen[:12]}…, {checksum.name} says {wanted[:12]}…: the file is damaged or was "
            "exchanged; restore both from the repository."
        )
    with np.load(path, allow_pickle=False) as file:
        arrays = {key: torch.from_numpy(file[key].astype(np.float32)) for key in file.files}
    return _filled(Denoiser(), "generator/", arrays, path), _filled(Discriminator(), "discriminator/", arrays, path)


def _filled(network: Network, prefix: str, arrays: dict[str, torch.Tensor], path: Path) -> Network:
    state = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    try:
        network.load_state_dict(state)
    except RuntimeError as err:
        raise WeightsError(f"{path.name} holds another network than this version's: {err}") from err
    return network.eval()

"""Make a separate environment for one of NVIDIA's grasp generators, so that its packages never affect this project's.

    python -m scripts.train.make_generator_env graspgen      # research and evaluation only: NVIDIA's licence
    python -m scripts.train.make_generator_env graspgenx

Afterwards `generator: graspgen`, `generator_options: {process: own, weights: FILE}` in the configuration use it.
Nothing else installs anything: a generator without its environment raises an error.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from hal.base.errors import Z1Error
from models.nvidia.nvidia import ENVIRONMENTS_FOLDER, log_licence

PACKAGES = {"graspgen": "eden-grasp-gen==0.1.7", "graspgenx": "eden-graspgenx==0.1.0"}
"""Package of each generator, in the version that its adapter was tested with."""
_TORCH = "torch>=2.6"  # older versions run code from a checkpoint


class InstallError(Z1Error, RuntimeError):
    """Environment that could not be made."""

    default_code = "install"


@dataclass(frozen=True, kw_only=True)
class Config:
    """Generator, and its build of PyTorch."""

    name: Annotated[Literal["graspgen", "graspgenx"], tyro.conf.Positional]
    """The generator."""
    torch_backend: str = "auto"
    """Build of PyTorch: `auto` fits this machine's GPU or none; `cpu`; empty takes PyPI's (4 GB, with CUDA)."""


def main(config: Config) -> int:
    """Make the environment; 0 when the generator's package can be found in it."""
    console = Console(highlight=False)
    log_licence(config.name)
    python = make_environment(config.name, find_uv(), config.torch_backend)
    console.print(f"{config.name} runs with {python}", soft_wrap=True)
    return 0


def find_uv() -> Path:
    """Return the path of the installer that `./z1` uses.

    Raises:
        InstallError: there is none.
    """
    own = ENVIRONMENTS_FOLDER.parent / "uv" / "bin" / "uv"
    found = shutil.which("uv") or (str(own) if own.is_file() else None)
    if found is None:
        raise InstallError(
            "the installer `uv` was not found; install it (https://docs.astral.sh/uv), then run this again.",
            code="no_uv",
        )
    return Path(found)


def make_environment(name: str, uv: Path, torch_backend: str = "", root: Path = ENVIRONMENTS_FOLDER) -> Path:
    """Make a new environment of `name` under `root` and return its Python; a failed one is removed.

    Raises:
        InstallError: `uv` failed; its output has the reason.
    """
    folder = root / name
    python = folder / "bin" / "python"
    backend = [f"--torch-backend={torch_backend}"] if torch_backend else []
    steps = [
        [str(uv), "venv", "--clear", "--python", sys.executable, str(folder)],
        [str(uv), "pip", "install", "--python", str(python), *backend, PACKAGES[name], _TORCH],
    ]
    folder.parent.mkdir(parents=True, exist_ok=True)
    for step in steps:
        if subprocess.run(step, check=False).returncode:
            shutil.rmtree(folder, ignore_errors=True)
            raise InstallError(f"`{' '.join(step)}` failed; its reason is above. Nothing was kept.", code="uv_failed")
    return python


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))

"""`./z1 docs`: serve the documentation on this machine, offline; `--build DIR` writes it as files instead."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from hal.base.errors import InvalidValueError, SdkMissingError

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class ServeDocsConfig:
    """Address, or output folder."""

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8000
    """TCP port to listen on."""
    build: Path | None = None
    """Folder for the finished site; nothing is served."""

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65535:
            raise InvalidValueError(
                f"docs: the port is out of range ({self.port}, allowed 1 to 65535). Choose another."
            )


Config = ServeDocsConfig


def main(config: ServeDocsConfig) -> int:
    """Serve until Ctrl-C, or build once; return the exit code of mkdocs.

    Raises:
        SdkMissingError: mkdocs-material is not installed.
    """
    if find_spec("mkdocs") is None or find_spec("material") is None:
        raise SdkMissingError("docs: mkdocs-material is not installed. Run: uv sync --inexact --group docs")
    return subprocess.run(make_command(config), cwd=ROOT, check=False).returncode


def make_command(config: ServeDocsConfig) -> list[str]:
    """Return the command line of mkdocs for `config`."""
    mkdocs = [sys.executable, "-m", "mkdocs"]
    if config.build is not None:
        return [*mkdocs, "build", "-f", "mkdocs.yml", "--site-dir", str(config.build.resolve())]
    return [*mkdocs, "serve", "-f", "mkdocs.yml", "--dev-addr", f"{config.host}:{config.port}"]

"""`./z1 check`: lint, format and types, the same commands as in CI."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """What to do about findings."""

    fix: bool = False
    """Repair what ruff can repair, and format."""


Config = CheckConfig


def main(config: CheckConfig) -> int:
    """Run all checks, even after one failed; return 1 if any did."""
    lint = ["ruff", "check", *(["--fix"] if config.fix else [])]
    layout = ["ruff", "format", *([] if config.fix else ["--check"])]
    types = ["pyright", "--level", "error"]  # warnings tell of modules without stubs
    failed = [step for step in (lint, layout, types) if not _passes(step)]
    for step in failed:
        print(f"error: `{' '.join(step)}` found something; see above.", file=sys.stderr)
    return 1 if failed else 0


def _passes(step: list[str]) -> bool:
    print(f"$ {' '.join(step)}", flush=True)
    return subprocess.run([sys.executable, "-m", *step], cwd=ROOT, check=False).returncode == 0

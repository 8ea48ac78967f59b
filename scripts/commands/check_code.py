"""`./z1 check`: lint, format, types and vocabulary, the same commands as in CI."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """Handling of findings."""

    fix: bool = False
    """Apply ruff's repairs and its format."""


Config = CheckConfig


def main(config: CheckConfig) -> int:
    """Run all checks, even after one failed; return 1 if any did."""
    lint = ["ruff", "check", *(["--fix"] if config.fix else [])]
    layout = ["ruff", "format", *([] if config.fix else ["--check"])]
    types = ["pyright", "--level", "error"]  # its warnings concern modules without stubs
    vocabulary = ["scripts.support.check_language"]
    failed = [step for step in (lint, layout, types, vocabulary) if not _passes(step)]
    for step in failed:
        print(f"error: `{' '.join(step)}` reports findings; see above.", file=sys.stderr)
    return 1 if failed else 0


def _passes(step: list[str]) -> bool:
    print(f"$ {' '.join(step)}", flush=True)
    # By the interpreter: the tools of this environment, whatever PATH has.
    return subprocess.run([sys.executable, "-m", *step], cwd=ROOT, check=False).returncode == 0

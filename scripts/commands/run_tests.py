"""`./z1 test [pytest options]`: the tests of this checkout; `-m faults` injects each fault and prints a table."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def main(arguments: list[str]) -> int:
    """Run pytest with `arguments` (default: everything that needs no hardware) and return its exit code."""
    import pytest

    os.chdir(ROOT)  # pytest's settings are in its pyproject.toml
    return int(pytest.main(arguments))

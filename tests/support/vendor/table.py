"""Table of a conformance run: each observation of the vendor's program and of the twin, and whether they agree.

`Z1_CTRL=PATH ./z1 test -m vendor` prints it; `--allow-motion` permits a program that commands a real arm.
"""

from __future__ import annotations

import sys

import pytest
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tests.support.vendor.observations import Observation

_ENOUGH_COLUMNS = 2000

Pair = tuple[Observation, Observation]
_PAIRS = pytest.StashKey[list[Pair]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--allow-motion", action="store_true", help="-m vendor: the program may command, and move, a real arm"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_PAIRS] = []


@pytest.fixture(scope="session")
def vendor_table(request: pytest.FixtureRequest) -> list[Pair]:
    """The rows of this run: the program's observation, and the twin's."""
    return request.config.stash[_PAIRS]


def pytest_terminal_summary(config: pytest.Config) -> None:
    if pairs := config.stash[_PAIRS]:
        is_screen = sys.stdout.isatty()
        table = Table("observed", "vendor", "twin", "same", box=box.ROUNDED if is_screen else box.MARKDOWN)
        for vendor, twin in pairs:
            cells = (vendor.name, _show(vendor.value), _show(twin.value), "yes" if vendor.equals(twin) else "NO")
            table.add_row(*map(escape, cells))
        Console(width=None if is_screen else _ENOUGH_COLUMNS).print(table)


def _show(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"

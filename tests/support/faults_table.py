"""Table of injected faults, the arm's reaction and the operator's message, printed by `./z1 test -m faults`.

A test takes the fixture `faults_table` and adds a row of its measurements; no value in it is fixed beforehand.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
import pytest
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hal.base.messages import ServoMode, ServoStatus
from hal.base.z1 import JOINT_NAMES, N_ARM

_ENOUGH_COLUMNS = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One fault."""

    fault: str
    """Injected fault."""
    arm: str
    """Reaction of the arm."""
    noticed_s: float | None
    """Time from the fault to its detection [s]; None where there is nothing to detect."""
    rest_s: float | None
    """Time from the fault to the arm's last motion [s]; None where it continued, or did not move."""
    reads: str
    """Message for the operator."""


class FaultsTable:
    """The rows of one run."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def add(
        self,
        fault: str,
        *,
        arm: str,
        reads: object,
        noticed_s: float | None = None,
        rest_s: float | None = None,
    ) -> None:
        """Add a row of measured values (see `Row`)."""
        self.rows.append(Row(fault=fault, arm=arm, noticed_s=noticed_s, rest_s=rest_s, reads=str(reads) or "nothing"))


def describe(status: ServoStatus, moved: np.ndarray) -> str:
    """Return the arm's reaction in words, from its `status` and its motion `moved` (7,) [rad] since the fault."""
    reactions = {ServoMode.STOPPED: "braked, stopped until re-armed", ServoMode.HOLDING: "braked, holds"}
    joint = int(np.abs(moved[:N_ARM]).argmax())
    further = f"{JOINT_NAMES[joint]} moved on by {1e3 * abs(moved[joint]):.0f} mrad"
    return f"{reactions.get(status.mode, status.mode.value)}; {further}"


_ROWS = pytest.StashKey[FaultsTable]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_ROWS] = FaultsTable()


@pytest.fixture(scope="session")
def faults_table(request: pytest.FixtureRequest) -> FaultsTable:
    """The table of this run."""
    return request.config.stash[_ROWS]


def pytest_terminal_summary(config: pytest.Config) -> None:
    rows = config.stash[_ROWS].rows
    if rows and config.option.markexpr == "faults":
        _print(rows)


def _print(rows: list[Row]) -> None:
    """Print the table as wide as the terminal is; into a file or a pipe as Markdown."""
    is_screen = sys.stdout.isatty()
    table = Table(title="Faults injected" if is_screen else None, box=box.ROUNDED if is_screen else box.MARKDOWN)
    for column, justify in (("fault", "left"), ("the arm", "left"), ("noticed", "right"), ("rests", "right")):
        table.add_column(column, justify=justify, overflow="fold")  # pyright: ignore[reportArgumentType]
    table.add_column("the operator reads", overflow="fold")
    for row in rows:
        cells = (row.fault, row.arm, _duration(row.noticed_s), _duration(row.rest_s), row.reads)
        table.add_row(*map(escape, cells), end_section=is_screen)
    Console(width=None if is_screen else _ENOUGH_COLUMNS).print(table)


def _duration(seconds: float | None) -> str:
    return "–" if seconds is None else f"{1e3 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"

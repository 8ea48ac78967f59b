"""What every solver starts from: the samples of a folder, with the board found in each."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from calibration.board.detection import BoardView, detect_board
from calibration.errors import CalibrationError, CalibrationWarning

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calibration.samples import Sample, Session


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenSamples:
    """Samples that show the board."""

    session: Session
    """What they have in common."""
    names: list[str]
    """(N,)."""
    samples: list[Sample]
    """(N,)."""
    views: list[BoardView]
    """(N,) the corners in each."""


def read_samples(folder: Path, console: Console) -> SeenSamples:
    """Return the samples of `folder` in which the board is found; the others are told on the console.

    Raises:
        CalibrationError: `folder` holds no session.
    """
    from calibration.samples import load_samples

    loaded = load_samples(folder)
    show_warnings(loaded.warnings, console)
    seen = SeenSamples(session=loaded.session, names=[], samples=[], views=[])
    for name, sample in zip(loaded.names, loaded.samples, strict=True):
        try:
            view = detect_board(sample.image, loaded.session.board)
        except CalibrationError as error:
            console.print(f"[yellow]sample {name} is left out:[/] {error}", soft_wrap=True)
            continue
        seen.names.append(name)
        seen.samples.append(sample)
        seen.views.append(view)
    return seen


def show_warnings(warnings: Sequence[CalibrationWarning], console: Console) -> None:
    """Print each warning as a line."""
    for warning in warnings:
        whose = f" ({', '.join(warning.samples)})" if warning.samples else ""
        console.print(f"[yellow]{warning.code}{whose}:[/] {warning}", soft_wrap=True)


def now() -> str:
    """Return the date and time, ISO 8601 with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")

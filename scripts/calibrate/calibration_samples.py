"""Samples of a folder with the board detected in each: the input of every solver."""

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

    from calibration.samples import CaptureInfo, Sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectedSamples:
    """Samples with a detected board."""

    info: CaptureInfo
    """Common properties."""
    names: list[str]
    """(N,)."""
    samples: list[Sample]
    """(N,)."""
    views: list[BoardView]
    """(N,) detected corners."""


def read_samples(folder: Path, console: Console) -> DetectedSamples:
    """Return the samples of `folder` with a detected board; print the others with their reason.

    Raises:
        CalibrationError: `no_session`.
    """
    from calibration.samples import load_samples

    loaded = load_samples(folder)
    show_warnings(loaded.warnings, console)
    detected = DetectedSamples(info=loaded.info, names=[], samples=[], views=[])
    for name, sample in zip(loaded.names, loaded.samples, strict=True):
        try:
            view = detect_board(sample.image, loaded.info.board)
        except CalibrationError as error:  # one view without a board must not discard the others
            console.print(f"[yellow]sample {name} is left out:[/] {error}", soft_wrap=True)
            continue
        detected.names.append(name)
        detected.samples.append(sample)
        detected.views.append(view)
    return detected


def show_warnings(warnings: Sequence[CalibrationWarning], console: Console) -> None:
    """Print one line for each warning."""
    for warning in warnings:
        names = f" ({', '.join(warning.samples)})" if warning.samples else ""
        console.print(f"[yellow]{warning.code}{names}:[/] {warning}", soft_wrap=True)


def now() -> str:
    """Return the date and time, ISO 8601 with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")

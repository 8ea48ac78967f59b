"""The progress bar of commands that run many scenarios: how many of how many, how long it took and how long is left."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


def make_progress(console: Console, of: str = "scenarios") -> Progress:
    """Return a bar that names what it counts in front, and shows each task's description at its end."""
    return Progress(
        TextColumn(of),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        console=console,
    )

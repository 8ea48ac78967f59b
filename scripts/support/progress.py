"""Progress bar of commands that run many scenarios, with the times elapsed and remaining."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


def make_progress(console: Console, of: str = "scenarios") -> Progress:
    """Return a bar with `of`, the name of the counted items, in front and each task's description at its end."""
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

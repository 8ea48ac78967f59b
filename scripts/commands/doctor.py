"""`./z1 doctor`: what of this machine is ready, and what to type for the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scripts.support import doctor_checks as checks
from scripts.support.doctor_checks import Check, State


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """Nothing to choose: every check runs."""


Config = DoctorConfig

NEEDED: Sequence[Callable[[], Check]] = (
    checks.check_python,
    checks.check_packages,
    checks.check_usb_library,
    checks.check_processors,
    checks.check_memory,
    checks.check_shared_memory,
    checks.check_disk,
    checks.check_bus_port,
)
"""Without these the demo cannot run."""
WELCOME: Sequence[Callable[[], Check]] = (
    checks.check_graphics,
    checks.check_gpu,
    checks.check_detector,
    checks.check_real_time,
    checks.check_locked_memory,
    checks.check_viewer_port,
    checks.check_camera,
    checks.check_arm,
)
"""These make it better, or belong to the real robot."""

_COLOURS = {State.OK: "green", State.WARN: "yellow", State.MISSING: "red"}


def main(config: DoctorConfig) -> int:
    """Print the table; return 0 when the demo can run."""
    from rich.console import Console
    from rich.table import Table

    needed, welcome = run_checks(NEEDED), run_checks(WELCOME)
    table = Table(title="This machine")
    table.add_column("what", no_wrap=True)
    for column in ("state", "seen", "fix"):
        table.add_column(column, overflow="fold")
    for group in (needed, welcome):
        for check in group:
            colour = _COLOURS[check.state]
            table.add_row(check.name, f"[{colour}]{check.state.value}[/]", _escape(check.seen), _escape(check.fix))
        table.add_section()
    Console().print(table)
    lacking = [check.name for check in needed if check.state is State.MISSING]
    print(f"the demo cannot run yet: see {', '.join(lacking)}" if lacking else "ready: ./z1 demo")
    return 1 if lacking else 0


def run_checks(functions: Sequence[Callable[[], Check]]) -> list[Check]:
    """Run each check; one that fails itself becomes a row that says so."""
    return [_run(function) for function in functions]


def _run(function: Callable[[], Check]) -> Check:
    try:
        return function()
    except Exception as error:  # one broken check must not hide the others
        name = function.__name__.removeprefix("check_").replace("_", " ")
        return Check(name, State.MISSING, f"the check itself failed: {type(error).__name__}: {error}", "report this")


def _escape(text: str) -> str:
    from rich.markup import escape

    return escape(text)

"""`./z1 doctor`: checks of this machine, with the command that fixes each failed one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scripts.support import doctor_checks as checks
from scripts.support.doctor_checks import Check, State


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """No options: every check runs."""


Config = DoctorConfig

REQUIRED: Sequence[Callable[[], Check]] = (
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
OPTIONAL: Sequence[Callable[[], Check]] = (
    checks.check_graphics,
    checks.check_gpu,
    checks.check_detector,
    checks.check_real_time,
    checks.check_locked_memory,
    checks.check_viewer_port,
    checks.check_camera,
    checks.check_arm,
)
"""These improve the demo, or concern the real robot."""

_COLOURS = {State.OK: "green", State.WARN: "yellow", State.MISSING: "red"}


def main(config: DoctorConfig) -> int:
    """Print the table; return 0 when the demo can run."""
    from rich.console import Console
    from rich.table import Table

    required, optional = run_checks(REQUIRED), run_checks(OPTIONAL)
    table = Table(title="This machine")
    table.add_column("check", no_wrap=True)
    for column in ("state", "found", "fix"):
        table.add_column(column, overflow="fold")
    for group in (required, optional):
        for check in group:
            colour = _COLOURS[check.state]
            # Square brackets in a driver's output are not markup
            table.add_row(check.name, f"[{colour}]{check.state.value}[/]", _escape(check.found), _escape(check.fix))
        table.add_section()
    Console().print(table)
    missing = [check.name for check in required if check.state is State.MISSING]
    print(f"the demo cannot run yet: see {', '.join(missing)}" if missing else "ready: ./z1 demo")
    return 1 if missing else 0


def run_checks(functions: Sequence[Callable[[], Check]]) -> list[Check]:
    """Run each check; one that raises becomes a row with its error."""
    return [_run(function) for function in functions]


def _run(function: Callable[[], Check]) -> Check:
    try:
        return function()
    except Exception as error:  # one broken check must not stop the others
        name = function.__name__.removeprefix("check_").replace("_", " ")
        return Check(name, State.MISSING, f"the check itself failed: {type(error).__name__}: {error}", "report this")


def _escape(text: str) -> str:
    from rich.markup import escape

    return escape(text)

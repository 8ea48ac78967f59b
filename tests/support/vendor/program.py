"""Conformance run of a controller program, as a process of its own: `python -m tests.support.vendor.program PROGRAM`.

It prints the observations as JSON. In a network namespace of its own the program reaches this process alone; the
address of the motor board is given to the loopback interface there, so that the program's configuration stays as it is.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict
from ipaddress import ip_address
from pathlib import Path

from hal.base.errors import HalError
from hal.z1_protocol.motor_board import BOARD_ADDRESS
from tests.support.vendor.grants import observe_grants
from tests.support.vendor.line import ProgramLine, TwinLine
from tests.support.vendor.observations import LONG, SHORT, Observation, Observer
from tests.support.vendor.probe import Probe

OBSERVERS = (*SHORT, *LONG, observe_grants)
"""All observers; each gets a newly started controller."""

_ROOT = Path(__file__).resolve().parents[3]
_REAL = "--real"
# A busy machine delays the board twin, and so the program's state machine: such a run is repeated.
_MAX_LATE_RATIO, _TRIES = 0.03, 4
# With a process namespace, too, the program ends with this process, however that one ends.
# Root keeps its right to real-time scheduling, which the program and the board twin use, outside a user namespace.
_NAMESPACE = ("unshare", *(["--map-root-user"] if os.geteuid() else []), "--net", "--pid", "--fork", "--kill-child")


class RealArmError(HalError):
    """The program would command a real arm."""

    default_code = "real_arm"


def observe_twin() -> list[Observation]:
    """Return the observations of the twin."""
    found = []
    for observe in OBSERVERS:
        line = TwinLine()
        line.run(0.3)
        found += observe(Probe(line))
    return found


def observe_program(program: Path, *, allow_motion: bool) -> list[Observation]:
    """Return the observations of a controller program.

    Args:
        program: the program.
        allow_motion: whether a real arm may be moved: then the program is started on this machine's network.

    Raises:
        RealArmError: its motor board is on another machine, no namespace can be made, and no motion is allowed.
    """
    board = read_board(program)
    real = not ip_address(board).is_loopback
    command = [sys.executable, "-P", "-m", "tests.support.vendor.program", str(program)]
    if real and allow_motion:
        command.append(_REAL)
    elif can_isolate():
        setup = f'ip link set lo up && ip address add {board}/32 dev lo 2>/dev/null; exec "$@"'
        command = [*_NAMESPACE, "sh", "-c", setup, "sh", *command]
    elif real:
        raise RealArmError(
            f"{program} would command the motor board at {board}, and this system makes no network namespace. Set the "
            f"IP of its config.xml to 127.0.0.1, or support the arm, stand clear, and add --allow-motion."
        )
    output = subprocess.run(command, cwd=_ROOT, check=True, stdout=subprocess.PIPE).stdout
    return [Observation(**values) for values in json.loads(output.splitlines()[-1])]


def read_board(program: Path) -> str:
    """Return the address of the motor board in the program's `../config/config.xml`."""
    config = program.resolve().parent.parent / "config" / "config.xml"
    found = re.search(r"<IP>\s*([0-9.]+)\s*</IP>", config.read_text()) if config.is_file() else None
    return found[1] if found else BOARD_ADDRESS


def can_isolate() -> bool:
    """Return whether this system makes network namespaces."""
    tried = subprocess.run([*_NAMESPACE, "ip", "link", "set", "lo", "up"], check=False, capture_output=True)
    return tried.returncode == 0


def main(arguments: list[str]) -> None:
    """Run all observers on the program."""
    program, real = Path(arguments[0]).resolve(), _REAL in arguments
    found: list[Observation] = []
    for observe in OBSERVERS:
        for _ in range(_TRIES):
            seen, late_ratio = _observe(program, observe, board=not real)
            print(f"{observe.__name__}: {100 * late_ratio:.1f} % of the commands late", file=sys.stderr, flush=True)
            if late_ratio <= _MAX_LATE_RATIO:
                break
        found += seen
    print(json.dumps([asdict(one) for one in found]))


def _observe(program: Path, observe: Observer, *, board: bool) -> tuple[list[Observation], float]:
    """Return the observations of a newly started program, and the ratio of its commands that were late."""
    with tempfile.TemporaryDirectory() as name:
        shutil.copytree(program.parent.parent / "config", Path(name) / "config")
        with ProgramLine(program, Path(name), board=board) as line:
            return list(observe(Probe(line))), line.late_commands / max(line.commands, 1)


if __name__ == "__main__":
    main(sys.argv[1:])

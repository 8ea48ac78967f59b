"""Two network namespaces joined by a virtual cable, made by the test where the machine permits it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

_ROBOT, _OUTSIDE = "10.77.0.1", "10.77.0.2"


@dataclass(frozen=True)
class Networks:
    """Prefixes of commands that run on the robot's PC and on a machine outside, and the robot's address."""

    robot: tuple[str, ...]
    outside: tuple[str, ...]
    address: str


@contextmanager
def make_networks() -> Iterator[Networks]:
    """Yield the two; where namespaces are not permitted both are this machine, at another loopback address."""
    with ExitStack() as stack:
        try:
            networks = _make_namespaces(stack)
        except (OSError, subprocess.CalledProcessError):
            networks = Networks((), (), "127.0.0.2")
        yield networks


def _make_namespaces(stack: ExitStack) -> Networks:
    robot = _hold(stack, "unshare", "--user", "--map-root-user", "--net")
    inside = ("nsenter", "--preserve-credentials", "--user", "--net", "--target", str(robot))
    outside = _hold(stack, *inside, "unshare", "--net")
    beyond = (*inside[:-1], str(outside))
    _run(*inside, *f"ip link add z1a type veth peer name z1b netns {outside}".split())
    for prefix, device, address in ((inside, "z1a", _ROBOT), (beyond, "z1b", _OUTSIDE)):
        _run(*prefix, "ip", "address", "add", f"{address}/24", "dev", device)
        for name in (device, "lo"):
            _run(*prefix, "ip", "link", "set", name, "up")
    return Networks(inside, beyond, _ROBOT)


def _hold(stack: ExitStack, *command: str) -> int:
    """Keep the namespace that `command` makes until the end; return its process."""
    process = subprocess.Popen(
        [*command, "sh", "-c", "echo $$; exec cat"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdin is not None and process.stdout is not None
    stack.callback(process.wait)
    stack.callback(process.stdin.close)  # ends `cat`
    if not (line := process.stdout.readline()):
        raise OSError("namespaces are not permitted")
    return int(line)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)

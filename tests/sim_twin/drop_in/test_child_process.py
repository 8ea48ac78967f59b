"""A child process of the twin ends with its parent, and reports why it could not start."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest

from hal.base.clock import WallClock
from hal.base.errors import HalError
from sim_twin.drop_in.child_process import ChildProcess
from tests.support.errors import raises

pytestmark = pytest.mark.integration

WAITS = "multiprocessing.connection:answer_challenge"
"""A role of the standard library that waits for a message until the connection is closed."""


def start(role: str = WAITS) -> ChildProcess:
    return ChildProcess(role, (b"key",), (), "the child")


def is_running(pid: int) -> bool:
    """Return whether the process exists and is no zombie."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def await_true(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    clock = WallClock()
    end_s = clock.now_s() + timeout_s
    while not condition():
        assert clock.now_s() < end_s
        clock.sleep_until(clock.now_s() + 0.005)


def test_it_ends_when_it_is_closed_and_only_once() -> None:
    child = start()
    assert child.running
    assert child.exit_reason(0.0) == ""
    child.close()
    assert not child.running
    child.close()


def test_it_ends_with_the_last_reference() -> None:
    child = start()
    pid = child.pid
    assert is_running(pid)
    del child
    await_true(lambda: not is_running(pid))


@pytest.mark.parametrize("kill", [False, True])
def test_it_ends_with_its_parent_even_when_that_is_killed(kill: bool) -> None:
    program = (
        "import sys; from sim_twin.drop_in.child_process import ChildProcess; "
        f"child = ChildProcess({WAITS!r}, (b'key',), (), 'the child'); "
        "print(child.pid, flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-P", "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        pid = int(process.stdout.readline())
        assert is_running(pid)
        if kill:
            process.kill()
        else:
            process.stdin.close()
    await_true(lambda: not is_running(pid))


def test_a_failed_start_reports_how_it_ended(capfd: pytest.CaptureFixture[str]) -> None:
    with raises(HalError, "process_ended") as caught:
        start("hal.nothing:serve").wait_ready()
    assert "the process of the child ended with code 1" in str(caught.value)
    assert "No module named 'hal.nothing'" in capfd.readouterr().err


def test_a_silent_end_is_reported() -> None:
    child = ChildProcess("hal.base.errors:HalError", (), (), "the child")  # makes an error, raises none, and ends
    with raises(HalError, "process_ended") as caught:
        child.wait_ready()
    assert "ended with code 0" in str(caught.value)
    with raises(HalError, "process_ended"):
        child.request("anything")

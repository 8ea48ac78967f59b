"""A process of the twin's own ends with whoever started it, and says why it could not begin."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest

from hal.base.clock import WallClock
from hal.base.errors import HalError
from sim_twin.drop_in.child_process import ChildProcess

WAITS = "multiprocessing.connection:answer_challenge"
"""A role of the standard library's: it waits for what never comes until the connection is closed."""


def start(role: str = WAITS) -> ChildProcess:
    return ChildProcess(role, (b"key",), (), "somebody")


def is_running(pid: int) -> bool:
    """Whether there is such a process, and not only its remains."""
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


def test_it_ends_when_nobody_refers_to_it_any_more() -> None:
    child = start()
    pid = child.pid
    assert is_running(pid)
    del child
    await_true(lambda: not is_running(pid))


@pytest.mark.parametrize("kill", [False, True])
def test_it_ends_with_the_process_that_started_it_even_when_that_is_killed(kill: bool) -> None:
    program = (
        "import sys; from sim_twin.drop_in.child_process import ChildProcess; "
        f"child = ChildProcess({WAITS!r}, (b'key',), (), 'somebody'); "
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


def test_one_that_cannot_begin_says_how_it_ended(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(HalError, match="the process of somebody ended with code 1; what it said is above"):
        start("hal.nothing:nobody").wait_ready()
    assert "No module named 'hal.nothing'" in capfd.readouterr().err


def test_one_that_ends_without_a_word_is_said_to_have_ended() -> None:
    child = ChildProcess("hal.base.errors:HalError", (), (), "somebody")  # makes an error, raises none, and ends
    with pytest.raises(HalError, match="ended with code 0"):
        child.wait_ready()
    with pytest.raises(HalError, match="ended with code 0"):
        child.ask("anything")

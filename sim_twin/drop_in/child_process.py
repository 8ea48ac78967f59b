"""A process of the twin's own: it answers this one's questions, and ends with it however this one ends.

Run as a module it is the child's side: `python -m sim_twin.drop_in.child_process DESCRIPTOR`.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from typing import Any

from hal.base.errors import HalError

_ENDING_S = 5.0
_DYING_S = 1.0


class ChildProcess:
    """Starts `role` in a new process; it ends by `close`, with the last reference to this, or with this process.

    Args:
        role: `"module:function"`; the function is called with the child's end of the connection and the arguments,
            sends `None` when it is ready, and returns when the connection is closed.
        arguments: for it; they are pickled.
        memory: file descriptors that are valid in the child, too.
        who: what it is, for messages.
    """

    def __init__(self, role: str, arguments: Sequence[Any], memory: Sequence[int], who: str) -> None:
        here, there = Pipe()
        self._who, self._connection, self._lock = who, here, threading.Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sim_twin.drop_in.child_process", str(there.fileno())],
            pass_fds=(there.fileno(), *memory),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process, which then ends that one in order
        )
        there.close()
        self.close: Callable[[], None] = weakref.finalize(self, _end, here, self._process)
        """End it. Harmless when it has ended."""
        with contextlib.suppress(OSError):  # it ended at once: `wait_ready` says so
            here.send((role, tuple(arguments)))

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def wait_ready(self) -> None:
        """Return once it is ready.

        Raises:
            HalError: it ended instead; the message is its own.
        """
        with self._lock:
            self._receive()

    def ask(self, question: Any) -> Any:
        """Return the answer to `question`.

        Raises:
            HalError: it has ended, or could not answer; the message is its own.
        """
        with self._lock:
            try:
                self._connection.send(question)
            except OSError as error:
                raise HalError(self.why_it_ended()) from error
            return self._receive()

    def why_it_ended(self, timeout_s: float = _DYING_S) -> str:
        """Return how it ended; empty while it runs, for `timeout_s` [s] longer: a connection breaks, and answers stay
        away, a while before a process is gone."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"the process of {self._who} {how}; what it said is above. Start again."

    def _receive(self) -> Any:
        try:
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise HalError(self.why_it_ended() or f"the process of {self._who} hung up") from error
        if isinstance(answer, HalError):
            raise answer
        return answer


def _end(connection: Connection, process: subprocess.Popen[bytes]) -> None:
    connection.close()
    try:
        process.wait(_ENDING_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def main(descriptor: int) -> None:
    """Be the child: take the role from the connection and play it."""
    connection = Connection(descriptor)
    role, arguments = connection.recv()
    module, function = role.split(":")
    try:
        getattr(import_module(module), function)(connection, *arguments)
    except HalError as error:
        connection.send(error)
    except (EOFError, BrokenPipeError, ConnectionResetError):  # whoever started this is gone
        pass


if __name__ == "__main__":
    main(int(sys.argv[1]))

"""A child process of the twin: it answers requests over a pipe, and ends with its parent however that one ends.

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

_END_TIMEOUT_S = 5.0
# A connection breaks, and answers stop, shortly before the process has an exit code [s].
_EXIT_CODE_WAIT_S = 1.0


class ChildProcess:
    """A new process that runs `role`; it ends by `close`, with the last reference to this, or with this process.

    Args:
        role: `"module:function"`; the function is called with the child's end of the connection and the arguments,
            sends `None` when it is ready, and returns when the connection is closed.
        arguments: arguments of the function; they are pickled.
        memory: file descriptors that are valid in the child, too.
        name: name of the process in messages.
    """

    def __init__(self, role: str, arguments: Sequence[Any], memory: Sequence[int], name: str) -> None:
        ours, theirs = Pipe()
        self._name, self._connection, self._lock = name, ours, threading.Lock()
        self._process = subprocess.Popen(
            # -P: no module of the working directory takes the place of an installed one
            [sys.executable, "-P", "-m", "sim_twin.drop_in.child_process", str(theirs.fileno())],
            pass_fds=(theirs.fileno(), *memory),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches the parent only, which then ends the child in order
        )
        # With a second copy open here, the connection would not break when the child ends
        theirs.close()
        self.close: Callable[[], None] = weakref.finalize(self, _end, ours, self._process)
        """End the process. Harmless when it has ended."""
        with contextlib.suppress(OSError):  # it ended at once: `wait_ready` reports it
            ours.send((role, tuple(arguments)))

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def wait_ready(self) -> None:
        """Wait until the process is ready.

        Raises:
            HalError: it ended instead; the message is its own.
        """
        with self._lock:
            self._receive()

    def request(self, request: Any) -> Any:
        """Return the answer to `request`.

        Raises:
            HalError: the process has ended, or could not answer; the message is its own.
        """
        with self._lock:
            try:
                self._connection.send(request)
            except OSError as error:
                raise HalError(self.exit_reason(), code="process_ended") from error
            return self._receive()

    def exit_reason(self, timeout_s: float = _EXIT_CODE_WAIT_S) -> str:
        """Return how the process ended; empty when it still runs after `timeout_s` [s]."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"the process of {self._name} {how}; its output is above. Start it again."

    def _receive(self) -> Any:
        try:
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            reason = self.exit_reason() or f"the process of {self._name} closed its connection; start it again."
            raise HalError(reason, code="process_ended") from error
        if isinstance(answer, HalError):
            raise answer
        return answer


def _end(connection: Connection, process: subprocess.Popen[bytes]) -> None:
    connection.close()
    try:
        process.wait(_END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def main(descriptor: int) -> None:
    """Run the child: receive the role and its arguments, and execute it."""
    connection = Connection(descriptor)
    role, arguments = connection.recv()
    module, function = role.split(":")
    try:
        getattr(import_module(module), function)(connection, *arguments)
    except HalError as error:
        connection.send(error)
    except (EOFError, BrokenPipeError, ConnectionResetError):  # the parent has ended
        pass


if __name__ == "__main__":
    main(int(sys.argv[1]))

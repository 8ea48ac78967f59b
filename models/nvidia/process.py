"""Generator in a process of its own, with a Python environment of its own."""

from __future__ import annotations

import subprocess
import threading
import weakref
from collections import deque
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import BinaryIO, cast

import numpy as np

from hal.base.errors import InvalidValueError
from models.nvidia.errors import GeneratorError
from models.nvidia.pipe import PROTOCOL, PipeError, read_message, write_message
from models.types import GraspSet, check_object_cloud

WORKER = Path(__file__).with_name("worker.py")
_EXIT_TIMEOUT_S = 2.0  # then the process is killed
_STDERR_LINES = 12  # enough for the end of a traceback

_Reply = dict[str, np.ndarray] | PipeError | None


class ProcessGenerator:
    """A `GraspGenerator` that runs in a process of its own.

    The process starts with the generator, and again at the first request after it died or timed out. It ends at
    `close`, when the generator is garbage collected, or when this process ends in any way.
    """

    def __init__(
        self,
        name: str,
        checkpoint: Path,
        python: Path,
        *,
        worker: Path = WORKER,
        start_timeout_s: float = 300.0,
        timeout_s: float = 60.0,
    ) -> None:
        """Start the process and wait until it has loaded its networks.

        Args:
            name: `graspgen` or `graspgenx`.
            checkpoint: the file or folder of its weights.
            python: interpreter with the generator's package.
            worker: script of the process.
            start_timeout_s: timeout of loading [s].
            timeout_s: timeout of a reply [s].

        Raises:
            GeneratorError: the process does not start, or its package or checkpoint cannot be used.
        """
        # -I: no path of the user may shadow the packages of that environment
        self._name, self._command = name, [str(python), "-I", str(worker), name, str(checkpoint)]
        self._start_timeout_s, self._timeout_s = start_timeout_s, timeout_s
        self._lock = threading.Lock()
        self._child: _Child | None = self._start()

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m], best score first, from the generator in the process.

        Raises:
            InvalidValueError: the cloud cannot be used.
            GeneratorError: the process died, timed out, or sent an invalid reply.
        """
        points = check_object_cloud(points, n)
        with self._lock:
            if self._child is None:
                self._child = self._start()
            reply = self._request(self._child, {"points": points, "n": n, "seed": seed}, self._timeout_s)
        if "error" in reply:
            raise self._error_of(reply)
        try:
            return GraspSet(
                T_camera_grasps=reply["T_camera_grasps"],
                scores=reply["scores"],
                widths_m=reply["widths_m"],
                source=str(reply["source"]),
            )
        except (KeyError, ValueError) as err:
            raise GeneratorError(
                f"the process of {self._name} sent a reply without grasps: {err}", code="bad_output"
            ) from err

    def close(self) -> None:
        """End the process; a later request starts it again."""
        with self._lock:
            if self._child is not None:
                self._child.end()
                self._child = None

    def _start(self) -> _Child:
        child = _Child(self._command)
        hello = self._request(child, None, self._start_timeout_s)
        if "error" in hello:
            child.end()
            raise GeneratorError(str(hello["error"]), code=str(hello["code"]))
        received = int(hello.get("protocol", np.array(-1)))
        if received != PROTOCOL:
            child.end()
            raise GeneratorError(
                f"the process of {self._name} has protocol version {received}; allowed is {PROTOCOL}.",
                code="protocol_version",
            )
        return child

    def _error_of(self, reply: dict[str, np.ndarray]) -> InvalidValueError | GeneratorError:
        """Return the error of a reply: about the cloud, or about the generator."""
        message, kind, code = (str(reply[key]) for key in ("error", "kind", "code"))
        if kind == "ValueError":
            return InvalidValueError(message, code=code)
        return GeneratorError(f"{self._name}: {kind}: {message}", code=code)

    def _request(
        self, child: _Child, request: dict[str, np.ndarray | int] | None, timeout_s: float
    ) -> dict[str, np.ndarray]:
        """Return the reply to `request`, or the first message for None; a child that fails is ended and dropped."""
        try:
            return child.request(request, timeout_s)
        except BaseException as err:  # also Ctrl-C: a late reply would be taken for the next one
            self._child = None
            child.end()
            if not isinstance(err, GeneratorError):
                raise
            raise GeneratorError(f"the process of {self._name} {err}{child.stderr_tail()}", code=err.code) from err


class _Child:
    """Child process, with its replies in a queue and the last lines of its stderr."""

    def __init__(self, command: list[str]) -> None:
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
        except OSError as err:
            raise GeneratorError(f"{command[0]} cannot be started: {err.strerror}.", code="process_start") from err
        assert self._process.stdin and self._process.stdout and self._process.stderr
        self._requests = cast(BinaryIO, self._process.stdin)
        self._replies: SimpleQueue[_Reply] = SimpleQueue()
        self._stderr_lines: deque[str] = deque(maxlen=_STDERR_LINES)
        self._threads = [
            threading.Thread(target=_read_replies, args=(self._process.stdout, self._replies), daemon=True),
            threading.Thread(target=_read_stderr, args=(self._process.stderr, self._stderr_lines), daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        weakref.finalize(self, _end, self._process)

    def request(self, request: dict[str, np.ndarray | int] | None, timeout_s: float) -> dict[str, np.ndarray]:
        """Send `request`, unless None, and return the next message.

        Raises:
            GeneratorError: no message, or an invalid one; the text continues "the process of …".
        """
        try:
            if request is not None:
                write_message(self._requests, request)
            reply = self._replies.get(timeout=timeout_s)
        except Empty:
            raise GeneratorError(f"sent no reply in {timeout_s:g} s and was ended.", code="process_timeout") from None
        except OSError:
            reply = None
        if isinstance(reply, PipeError):
            raise GeneratorError(f"sent an invalid reply: {reply}", code=reply.code)
        if reply is None:
            _end(self._process)
            raise GeneratorError(f"ended with code {self._process.returncode}.", code="process_ended")
        return reply

    def stderr_tail(self) -> str:
        """Return the last lines of its stderr, indented, after it has ended."""
        self._threads[1].join(_EXIT_TIMEOUT_S)
        return "".join(f"\n    {line}" for line in self._stderr_lines)

    def end(self) -> None:
        """End the process and wait for its exit."""
        _end(self._process)


def _end(process: subprocess.Popen) -> None:
    with suppress(OSError):  # it may have exited within a request
        process.stdin.close()  # type: ignore[union-attr]
    try:
        process.wait(_EXIT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _read_replies(stream: BinaryIO, replies: SimpleQueue[_Reply]) -> None:
    try:
        while (message := read_message(stream)) is not None:
            replies.put(message)
        replies.put(None)
    except PipeError as err:
        replies.put(err)


def _read_stderr(stream: BinaryIO, lines: deque[str]) -> None:
    for line in stream:
        lines.append(line.decode(errors="replace").rstrip())

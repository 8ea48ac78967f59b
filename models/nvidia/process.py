"""A generator that runs in its own process, with a Python whose packages are its own business."""

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
from models.nvidia.wire import PROTOCOL, PipeError, read_message, write_message
from models.types import GraspSet, check_object_cloud

WORKER = Path(__file__).with_name("worker.py")
_ENDING_S = 2.0
_LAST_LINES = 12

_Answer = dict[str, np.ndarray] | PipeError | None


class ProcessGenerator:
    """A `GraspGenerator` that asks a process of its own.

    The process starts with the generator, and anew at the first request after it died or was too slow. It ends when
    `close` is called, when nobody holds the generator any more, or when this process ends, however it does.
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
        """Start it and wait until it has loaded its networks.

        Args:
            name: `graspgen` or `graspgenx`.
            checkpoint: the file or folder of its weights.
            python: the interpreter that has its package.
            worker: what that runs.
            start_timeout_s: how long loading may take [s].
            timeout_s: how long an answer may take [s].

        Raises:
            GeneratorError: it does not start, or its package or checkpoint is at fault.
        """
        self._name, self._command = name, [str(python), "-I", str(worker), name, str(checkpoint)]
        self._start_timeout_s, self._timeout_s = start_timeout_s, timeout_s
        self._lock = threading.Lock()
        self._child: _Child | None = self._start()

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m], best score first, as the generator in the process does.

        Raises:
            ValueError: the cloud is at fault.
            GeneratorError: the process died, gave no answer in time, or an answer that is none.
        """
        points = check_object_cloud(points, n)
        with self._lock:
            if self._child is None:
                self._child = self._start()
            answer = self._ask(self._child, {"points": points, "n": n, "seed": seed}, self._timeout_s)
        if "error" in answer:
            message, kind = str(answer["error"]), str(answer["kind"])
            raise (
                InvalidValueError(message)
                if kind == "ValueError"
                else GeneratorError(f"{self._name}: {kind}: {message}")
            )
        try:
            return GraspSet(
                T_camera_grasps=answer["T_camera_grasps"],
                scores=answer["scores"],
                widths_m=answer["widths_m"],
                source=str(answer["source"]),
            )
        except (KeyError, ValueError) as err:
            raise GeneratorError(f"the process of {self._name} gave an answer that is no grasps: {err}") from err

    def close(self) -> None:
        """End the process; a later request would start it anew."""
        with self._lock:
            if self._child is not None:
                self._child.end()
                self._child = None

    def _start(self) -> _Child:
        child = _Child(self._command)
        hello = self._ask(child, None, self._start_timeout_s)
        if "error" in hello:
            child.end()
            raise GeneratorError(str(hello["error"]))
        seen = int(hello.get("protocol", np.array(-1)))
        if seen != PROTOCOL:
            child.end()
            raise GeneratorError(f"the process of {self._name} speaks version {seen}; allowed is {PROTOCOL}.")
        return child

    def _ask(
        self, child: _Child, request: dict[str, np.ndarray | int] | None, timeout_s: float
    ) -> dict[str, np.ndarray]:
        """Return the answer to `request`, or to nothing the first; a child that fails is ended and forgotten."""
        try:
            return child.ask(request, timeout_s)
        except BaseException as err:  # also Ctrl-C: what was asked would be taken for the next answer
            self._child = None
            child.end()
            if not isinstance(err, GeneratorError):
                raise
            raise GeneratorError(f"the process of {self._name} {err}{child.last_words()}") from err


class _Child:
    """The process, with what it answers in a queue and what it says last."""

    def __init__(self, command: list[str]) -> None:
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
        except OSError as err:
            raise GeneratorError(f"{command[0]} cannot be started: {err.strerror}.") from err
        assert self._process.stdin and self._process.stdout and self._process.stderr
        self._requests = cast(BinaryIO, self._process.stdin)
        self._answers: SimpleQueue[_Answer] = SimpleQueue()
        self._said: deque[str] = deque(maxlen=_LAST_LINES)
        self._threads = [
            threading.Thread(target=_read_answers, args=(self._process.stdout, self._answers), daemon=True),
            threading.Thread(target=_read_words, args=(self._process.stderr, self._said), daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        weakref.finalize(self, _end, self._process)

    def ask(self, request: dict[str, np.ndarray | int] | None, timeout_s: float) -> dict[str, np.ndarray]:
        """Send `request`, unless None, and return what comes.

        Raises:
            GeneratorError: nothing, or nothing useful; the message goes on "the process of …".
        """
        try:
            if request is not None:
                write_message(self._requests, request)
            answer = self._answers.get(timeout=timeout_s)
        except Empty:
            raise GeneratorError(f"gave no answer in {timeout_s:g} s and was ended.") from None
        except OSError:
            answer = None
        if isinstance(answer, PipeError):
            raise GeneratorError(f"gave no proper answer: {answer}")
        if answer is None:
            _end(self._process)
            raise GeneratorError(f"ended with code {self._process.returncode}.")
        return answer

    def last_words(self) -> str:
        """Return what it said last, each line indented, after it has ended."""
        self._threads[1].join(_ENDING_S)
        return "".join(f"\n    {line}" for line in self._said)

    def end(self) -> None:
        """End it; it is gone when this returns."""
        _end(self._process)


def _end(process: subprocess.Popen) -> None:
    with suppress(OSError):  # it has gone with a request half read
        process.stdin.close()  # type: ignore[union-attr]
    try:
        process.wait(_ENDING_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _read_answers(stream: BinaryIO, answers: SimpleQueue[_Answer]) -> None:
    try:
        while (message := read_message(stream)) is not None:
            answers.put(message)
        answers.put(None)
    except PipeError as err:
        answers.put(err)


def _read_words(stream: BinaryIO, said: deque[str]) -> None:
    for line in stream:
        said.append(line.decode(errors="replace").rstrip())

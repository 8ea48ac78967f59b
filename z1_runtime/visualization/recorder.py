"""One Rerun recording and its sinks: a file, a live view, or both."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import rerun as rr

from hal.base.errors import UsageError
from hal.base.z1 import JOINT_NAMES
from z1_runtime.visualization import blueprint
from z1_runtime.visualization.robot_view import Drawing, RobotView

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"


class ViewerPortError(UsageError):
    """The port of the live view is taken."""

    default_code = "viewer_port"


class Recorder:
    """One recording; used by one thread at a time."""

    def __init__(self, out: Path | None, port: int | None) -> None:
        """Open the file `out` and a server on `port` of the loopback, whichever are given.

        Raises:
            ViewerPortError: another program listens on `port`.
            OSError: the file cannot be written.
        """
        self.robot = RobotView()
        self._stream = rr.RecordingStream("z1_grasp")
        # Wall and tick timelines would double the size of every entry, and are meaningless in lock-step.
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        sinks: list[Any] = []
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            sinks.append(rr.FileSink(str(out)))
        if port is not None:
            _check_free(port)
            sinks.append(rr.GrpcServerSink(LOOPBACK, port))
        try:
            self._stream.set_sinks(*sinks, default_blueprint=blueprint.make_blueprint())
        except RuntimeError as error:
            raise OSError(
                f"recording: {out} cannot be written ({error}). Free disk space, or choose another folder."
            ) from error
        if port is not None:
            _open_viewer(port)

    def write(self, stamp_s: float, draw: Callable[[], Drawing]) -> None:
        """Log the entities that `draw` yields at `stamp_s` [s]."""
        self._stream.set_time(blueprint.TIMELINE, duration=stamp_s)
        for path, entity in draw():
            self._stream.log(path, entity)

    def write_static(self) -> None:
        """Log the static entities: axes, meshes, and the names of the plots."""
        self._stream.log(blueprint.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for path, entity in self.robot.draw_links():
            self._stream.log(path, entity, static=True)
        for path, suffix in ((blueprint.POSITION, ""), (blueprint.COMMAND, " command"), (blueprint.TORQUE, "")):
            names = [f"{name}{suffix}" for name in JOINT_NAMES]
            self._stream.log(
                path, rr.SeriesLines(names=names, widths=[1.0 if suffix else 2.0] * len(names)), static=True
            )

    def close(self, timeout_s: float) -> None:
        """Flush to the sinks, for at most `timeout_s` [s], and close them."""
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except (RuntimeError, TimeoutError, ValueError) as error:
            logger.warning("the recording may lack its end: %s", error)
        # Rerun waits for its writer without a timeout, also for one that a full disk has ended.
        closing = Thread(target=self._stream.disconnect, name="recording closes", daemon=True)
        closing.start()
        closing.join(timeout_s)
        if closing.is_alive():
            rr.unregister_shutdown()  # it would wait again at Python's exit


def _check_free(port: int) -> None:
    # Rerun's server only logs that its port is taken, and then shows nothing.
    with socket.socket() as probe:
        # Connections of an ended view, in TIME_WAIT, must not count as a listener.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise ViewerPortError(
                f"live view: port {port} of {LOOPBACK} is taken ({error.strerror}). Close the other live view, or "
                "choose another port."
            ) from error


def _open_viewer(port: int) -> None:
    url = f"rerun+http://{LOOPBACK}:{port}/proxy"
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        logger.warning("no screen here: open the live view with `.venv/bin/rerun %s`", url)
        return
    # With a URL the viewer only connects; bound to the loopback, other machines cannot reach it.
    command = [sys.executable, "-m", "rerun", "--bind", LOOPBACK, url]
    subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)

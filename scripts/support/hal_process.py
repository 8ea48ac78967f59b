"""A HAL process of the twin as a child of this one."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from hal.base.errors import HalError
from hal.base.output_folder import create_file
from hal.bus.session import BusConfig
from scripts.support.scene_options import SceneOptions

READY = "ready"
"""Line that a HAL process prints when it accepts requests."""
_SHUTDOWN_S = 10.0  # braking takes under 1 s; the rest is for Zenoh and the renderer
_EXIT_S = 0.5  # the link may break before the process has exited


class HalProcess:
    """A HAL process of the twin that ends with this one, also when this one is killed.

    Args:
        scene: objects on the table.
        bus: address that it listens on.
        log: file of its log.
        hal: the twin's rig, `sim` or `wire-sim`.
    """

    def __init__(self, scene: SceneOptions, bus: BusConfig, log: Path, hal: str = "sim") -> None:
        self._log, self._ready = log, False
        with create_file(log) as stderr:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "scripts.cli", "hal", "--options-from-stdin"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                start_new_session=True,  # Ctrl-C reaches this process only, which then ends the child in order
            )
        assert self._process.stdin is not None
        # Stays open: its end ends the child, also when this process is killed.
        self._process.stdin.write(encode_options(hal, scene, bus))
        self._process.stdin.flush()

    def wait_ready(self) -> None:
        """Return when the HAL accepts requests.

        Raises:
            HalError: it ended instead; the message is its own.
        """
        assert self._process.stdout is not None
        if self._process.stdout.readline().decode().strip() != READY:  # an empty line: it has ended
            self._process.wait()
            raise HalError(self.exit_reason())
        self._ready = True

    def exit_reason(self) -> str:
        """Return its last error, or at least its exit code; empty while it runs."""
        try:
            code = self._process.wait(timeout=_EXIT_S)
        except subprocess.TimeoutExpired:
            return ""
        lines = self._log.read_text(errors="replace").splitlines()
        errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        return errors[-1] if errors else f"the HAL process ended with code {code}; see {self._log}"

    def end(self) -> None:
        """Let the HAL brake and exit; one that is still starting is terminated."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        if not self._ready:  # nothing to brake yet, and standard input is not watched yet
            self._process.terminate()
        try:
            self._process.wait(timeout=_SHUTDOWN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def encode_options(hal: str, scene: SceneOptions, bus: BusConfig) -> bytes:
    """Return the options of `./z1 hal --options-from-stdin`: one line of JSON."""
    return json.dumps({"hal": hal, "scene": asdict(scene), "bus": asdict(bus)}).encode() + b"\n"


def decode_options(line: bytes) -> tuple[str, SceneOptions, BusConfig]:
    """Return rig, scene and bus from one line of `encode_options`."""
    options = json.loads(line)
    return options["hal"], SceneOptions(**options["scene"]), BusConfig(**options["bus"])

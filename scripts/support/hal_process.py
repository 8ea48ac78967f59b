"""A HAL process of the twin as a child of this one."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from hal.base.errors import HalError
from hal.bus.session import BusConfig
from sim_twin.model.scene import SceneConfig

READY = "ready"
"""The line that a HAL process prints once everything answers."""
_BRAKING_S = 10.0
_DYING_S = 0.5
"""The link may break before the process is gone."""


class HalProcess:
    """A HAL process of the twin; it ends with this one, whatever happens to this one.

    Args:
        scene: what stands on the table.
        bus: where it listens.
        log: file for what it says.
        hal: which rig of the twin's, `sim` or `wire-sim`.
    """

    def __init__(self, scene: SceneConfig, bus: BusConfig, log: Path, hal: str = "sim") -> None:
        # What is as it always is stays unsaid: a served scene has fewer options than a benchmark's.
        changed = {f.name: value for f in fields(scene) if (value := getattr(scene, f.name)) != f.default}
        options = {**changed, **asdict(bus)}
        for name in ("noise", "board"):  # a served camera always has its noise; no demo has a board
            options.pop(name, None)
        arguments = [_option(name, value) for name, value in options.items()]
        self._log, self._ready = log, False
        with log.open("wb") as stderr:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "scripts.cli", "hal", f"--hal={hal}", "--until-stdin-closes", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                start_new_session=True,  # Ctrl-C is for this process, which then ends that one in order
            )

    def wait_ready(self) -> None:
        """Return once the HAL answers.

        Raises:
            HalError: it ended instead; the message is its own.
        """
        assert self._process.stdout is not None
        if self._process.stdout.readline().decode().strip() != READY:
            self._process.wait()
            raise HalError(self.why_it_ended())
        self._ready = True

    def why_it_ended(self) -> str:
        """Return its own last words, or at least how it ended; empty while it runs."""
        try:
            code = self._process.wait(timeout=_DYING_S)
        except subprocess.TimeoutExpired:
            return ""
        lines = self._log.read_text(errors="replace").splitlines()
        errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        return errors[-1] if errors else f"the HAL process ended with code {code}; see {self._log}"

    def end(self) -> None:
        """Let the HAL brake and end; one that is still starting has nothing to brake."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        if not self._ready:
            self._process.terminate()
        try:
            self._process.wait(timeout=_BRAKING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _option(name: str, value: Any) -> str:
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{option}" if value else f"--no-{option}"
    return f"--{option}={value}"

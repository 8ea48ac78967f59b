"""Rerun recordings of what a method saw, ranked and chose in an episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.rows import Attempt
from z1_runtime.visualization.rerun_logger import RerunLogger

_CLOSE_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Recordings:
    """Which episodes are recorded as they are run, and where to."""

    folder: Path
    choice: Literal["failures", "all"]

    def wants(self, *, success: bool) -> bool:
        """Return whether an episode that ended so is recorded."""
        return self.choice == "all" or not success


def record(path: Path, attempt: Attempt) -> Path:
    """Write the clouds, the candidates, the box and the plan of `attempt`, as far as it came to them, to `path`.

    Raises:
        ValueError: nothing was seen.
    """
    if attempt.seen is None:
        raise InvalidValueError(f"an attempt in which nothing was seen cannot be recorded as {path}.")
    observation, ranked = attempt.seen.observation, attempt.ranked
    inspector = RerunLogger(path)
    inspector.log_observation(observation)
    if ranked is not None:
        inspector.log_box(ranked.box, ranked.faces, observation.T_base_camera)
        inspector.log_candidates(ranked.grasps, observation.T_base_camera)
    if attempt.plan is not None:
        inspector.log_plan(attempt.plan)
    inspector.close(_CLOSE_S)
    return path

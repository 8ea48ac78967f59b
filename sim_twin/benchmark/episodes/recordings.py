"""Rerun recordings of observation, ranking and plan of an episode."""

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
    """Choice of the episodes to record, and their folder."""

    folder: Path
    choice: Literal["failures", "all"]

    def wants(self, *, success: bool) -> bool:
        """Return whether an episode with this outcome is recorded."""
        return self.choice == "all" or not success


def record(path: Path, attempt: Attempt) -> Path:
    """Write the clouds, the candidates, the box and the plan of `attempt`, as far as there are any, to `path`.

    Raises:
        InvalidValueError: nothing was observed.
    """
    if attempt.shared is None:
        raise InvalidValueError(
            f"recording: the attempt has no observation to write to {path}. Record attempts with a detection.",
            code="no_observation",
        )
    observation, ranked = attempt.shared.observation, attempt.ranked
    inspector = RerunLogger(path)
    inspector.log_observation(observation)
    if ranked is not None:
        inspector.log_box(ranked.box, ranked.faces, observation.T_base_camera)
        inspector.log_candidates(ranked.grasps, observation.T_base_camera)
    if attempt.plan is not None:
        inspector.log_plan(attempt.plan)
    inspector.close(_CLOSE_S)
    return path

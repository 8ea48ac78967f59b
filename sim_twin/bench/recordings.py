"""Rerun recordings of what a method saw, ranked and chose in an episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from models.mvbb import RankedGrasps
from z1_runtime.inspect import Inspector
from z1_runtime.types import GraspPlan, Observation

_CLOSE_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Recordings:
    """Which episodes are recorded, and where to."""

    folder: Path
    choice: Literal["failures", "all"]

    def keep(
        self, name: str, *, success: bool, observation: Observation, ranked: RankedGrasps | None, plan: GraspPlan | None
    ) -> None:
        """Write <name>.rrd with the clouds, the candidates, the box and the plan, as far as it came to them.

        Args:
            name: of the episode.
            success: how it ended; a success is written only if all are.
            observation: what was seen.
            ranked: the candidates in the order they were tried.
            plan: what was executed.
        """
        if success and self.choice == "failures":
            return
        inspector = Inspector(self.folder / f"{name}.rrd")
        inspector.log_observation(observation)
        if ranked is not None:
            inspector.log_box(ranked.box, ranked.faces, observation.T_base_camera)
            inspector.log_candidates(ranked.grasps, observation.T_base_camera)
        if plan is not None:
            inspector.log_plan(plan)
        inspector.close(_CLOSE_S)

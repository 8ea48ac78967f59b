"""Search for solvable scenarios: grasps swept over the object's true shape, executed until one holds.

The oracle uses no image: it has the object's true shape and pose. A grasp that passes the planner's own checks in the
true scene is executed in a fresh world, one grasp after the other, each as dissimilar to the failed ones as possible.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import version

from hal.base.clock import Stopwatch
from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.execution import EpisodeRobot, Mode, Outcome
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.benchmark.oracle.candidates import SweepConfig
from sim_twin.benchmark.oracle.reachable_grasps import EXACT_PLANNER, GraspQueue, GroundTruthScene
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.planning.config import PlannerConfig
from z1_runtime.types import GraspPlan, Rejection, RejectionReason

METHOD = "oracle"


@dataclass(frozen=True, slots=True, kw_only=True)
class OracleConfig:
    """Budget and sweeps of a search."""

    executions: int = 40
    """Grasps that are executed, each in a fresh world, before a scenario counts as not solved."""
    plannings: int = 600
    """Grasps whose motion is planned before then."""
    finer_after: int = 12
    """Failed executions after which the finer sweep is made."""
    sweep: SweepConfig = field(default_factory=SweepConfig)
    """The first sweep, whose grasps are counted."""
    finer: SweepConfig = field(
        default_factory=lambda: SweepConfig(
            n_points=900, n_approaches=24, depths_m=(0.0, 0.008), cell_m=0.010, cell_sine=0.3, seed=1
        )
    )
    """The sweep that follows where all of the first fails."""
    planner: PlannerConfig = EXACT_PLANNER
    """Planner settings for an exactly known scene."""
    speed: float = 0.5
    """Fraction of the arm's limits that motions use."""

    def __post_init__(self) -> None:
        if min(self.executions, self.plannings, self.finer_after) < 1:
            raise InvalidValueError(
                f"oracle: executions, plannings or finer_after is out of range ({self.executions}, "
                f"{self.plannings} and "
                f"{self.finer_after}, allowed 1 or more). Raise the budget.",
                code="oracle_budget",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class OracleTask:
    """One scenario to be searched."""

    scenario: Scenario
    config: OracleConfig


def run_oracle_task(task: OracleTask) -> list[Row]:
    """Return the row of one scenario, as a list of one."""
    return [search(task.scenario, task.config)]


def search(scenario: Scenario, config: OracleConfig) -> Row:
    """Search for a grasp that lifts the object of `scenario`; return the result as a table's row.

    `success` says whether one did, `verdict` how the search ended: `solved`; `unsolved`, all that was executed failed;
    `unreachable`, nothing can be executed. `executions` counts, `modes` names them in turn, and the other figures
    are of the last one. `n_candidates`, `n_clear` and `n_reachable` are of the first sweep: the grasps, those with
    clearance for the gripper, and the reachable placements (two per grasp).
    """
    watch = Stopwatch()
    search_run = _Search(scenario, config)
    for _ in search_run.run():
        pass
    row: Row = {**scenario.columns(), "method": METHOD, "version": version("z1-grasp")}
    return row | search_run.report() | {"search_ms": watch.lap_ms()}


class _Search:
    """One scenario's search."""

    def __init__(self, scenario: Scenario, config: OracleConfig) -> None:
        self._scene, self._config = scenario.scene(), config
        self._ground_truth = GroundTruthScene(self._scene, _kinematics(), config.planner, config.speed)
        self._counted: GraspQueue | None = None
        self._modes: list[Mode] = []
        self._rejected: Counter[str] = Counter()
        self._last: tuple[GraspPlan, Outcome] | None = None
        self._exhausted = False

    def run(self) -> Iterator[Outcome]:
        """Yield the outcome of each execution; end with the first success, or when options or budget are spent."""
        find_grasps = self._counted = self._ground_truth.find_grasps(self._config.sweep)
        finer = False
        while not self._is_over():
            choice = None if not finer and len(self._modes) >= self._config.finer_after else find_grasps.next()
            if choice is None and finer:
                self._exhausted = True
                return
            if choice is None:
                find_grasps, finer = find_grasps.with_failures(self._ground_truth.find_grasps(self._config.finer)), True
                continue
            plan = self._ground_truth.plan(choice)
            if isinstance(plan, Rejection):
                self._rejected[plan.reason] += 1
                # A rejected grasp counts as a failed one, which lowers the value of similar ones
                find_grasps.add_failure(choice)
                continue
            outcome = self._execute(plan)
            find_grasps.add_failure(choice)
            yield outcome

    def _is_over(self) -> bool:
        config = self._config
        solved = bool(self._modes) and self._modes[-1] is Mode.SUCCESS
        return solved or len(self._modes) >= config.executions or self._rejected.total() >= config.plannings

    def _execute(self, plan: GraspPlan) -> Outcome:
        with EpisodeRobot(self._scene, self._ground_truth.kinematics, self._config.speed) as robot:
            outcome = robot.execute(plan)
        self._modes.append(outcome.mode)
        self._last = plan, outcome
        return outcome

    def report(self) -> Row:
        """Return the result as columns."""
        counted = self._counted
        assert counted is not None, "nothing was searched"
        success = bool(self._modes) and self._modes[-1] is Mode.SUCCESS
        row: Row = {
            "success": success,
            "verdict": "solved" if success else "unsolved" if self._modes else "unreachable",
            "exhausted": self._exhausted,
            "executions": len(self._modes),
            "modes": [mode.value for mode in self._modes],
            "n_candidates": counted.n_candidates,
            "n_clear": counted.n_clear,
            "n_reachable": len(counted),
        }
        row |= {f"rejected_{reason}": counted.rejected[reason] + self._rejected[reason] for reason in RejectionReason}
        if self._last is None:
            return row
        plan, outcome = self._last
        row |= asdict(outcome) | {"mode": outcome.mode.value}
        return row | {
            "width_m": plan.width_m,
            "jaw_open": plan.jaw_open,
            "T_base_grasp": plan.T_base_grasp.ravel().tolist(),
            "T_base_pivot": plan.T_base_pivot.ravel().tolist(),
        }


@cache
def _kinematics() -> Kinematics:
    """Return one arm's kinematics for all scenarios of this process."""
    return Kinematics()

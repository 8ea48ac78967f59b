"""Safety guard: the arm stays inside a workspace box, above the table, and clear of itself, for every client.

Trajectories are checked point by point before they are queued; single setpoints when they arrive, and again every tick
at the position where the arm would come to rest if it braked now.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError

_SLACK_M = 1e-3  # an arm at rest on the boundary may be commanded to stay there
_ROUNDING_M = 1e-9  # a larger value would let repeated attempts creep outwards


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Allowed space of the gripper, in the base frame; the defaults are all that the arm can reach above its table."""

    lower_m: tuple[float, float, float] = (-0.9, -0.9, -0.5)
    """Lower corner of a box for every point of the gripper [m]."""
    upper_m: tuple[float, float, float] = (0.9, 0.9, 1.2)
    """Upper corner [m]."""
    table_m: float = -0.002
    """Minimum height of every point of gripper and links [m]; the base is mounted on z = 0."""
    self_m: float = -0.020
    """Minimum distance between the arm's links in this coarse model [m]: its capsules are up to 10 mm thicker than the
    links, and overlap by 13 mm where the folded arm rests on itself."""

    def __post_init__(self) -> None:
        numbers = (*self.lower_m, *self.upper_m, self.table_m, self.self_m)
        if not np.isfinite(numbers).all() or any(a >= b for a, b in zip(self.lower_m, self.upper_m, strict=True)):
            raise InvalidValueError(
                f"{self} must be finite, and lower_m below upper_m along every axis.", code="invalid_workspace"
            )


class Margins(NamedTuple):
    """Distances of postures to the guard's boundaries; negative is outside."""

    box_m: np.ndarray
    """(N,) from the gripper to the nearest side of the box [m]."""
    table_m: np.ndarray
    """(N,) from the lowest point of gripper and links to the table [m]."""
    self_m: np.ndarray
    """(N,) between the two nearest links of the arm, less the minimum distance [m]."""


class Violation(NamedTuple):
    """A posture outside the guard's boundaries."""

    index: int
    """Index of the posture."""
    code: str
    """Boundary: `workspace`, `table` or `self_collision`; the code of the `GuardError`."""
    text: str
    """Predicate for an error text, with the depth."""


_BOUNDARIES = (
    ("workspace", "moves the gripper {} mm out of the workspace box"),
    ("table", "goes {} mm below the table's plane"),
    ("self_collision", "brings links of the arm {} mm too close to each other"),
)
"""Code and text of each field of `Margins`."""


class Guard:
    """The check of postures against a workspace; it has no state, so any thread may use it."""

    def __init__(self, workspace: Workspace | None = None) -> None:
        self.workspace = workspace or Workspace()
        # Numba takes about a second to load: only a process with a guard waits for it.
        from hal.servo.guard_kernels import measure_margins

        self._measure = measure_margins
        self._corners = np.array(self.workspace.lower_m), np.array(self.workspace.upper_m)
        self._joints = _joint_placements()
        self.compute_margins(np.zeros((1, z1.N_JOINTS)))  # compiled before anything moves

    def compute_margins(self, q: np.ndarray) -> Margins:
        """Return the margins of postures `q` (N, 7) [rad], in some microseconds each."""
        # A writable copy: a read-only array is another type to the compiler, which would compile again in motion.
        q = np.array(q, dtype=np.float64, order="C")
        box, table, own = self._measure(q, self._joints, *self._corners, z1.T_FLANGE_PIVOT)
        space = self.workspace
        return Margins(box, table - space.table_m, own - space.self_m)

    def find_violation(self, q: np.ndarray, q_now: np.ndarray) -> Violation | None:
        """Return the first of the postures `q` (N, 7) that is outside, or None.

        An arm that is outside already, at `q_now` (7,), may move as long as it does not get further out: otherwise it
        could never be brought back.
        """
        now, requested = self.compute_margins(q_now[None]), self.compute_margins(q)
        earliest: Violation | None = None
        for here, there, (code, text) in zip(now, requested, _BOUNDARIES, strict=True):
            outside = np.flatnonzero(there < min(-_SLACK_M, float(here[0]) - _ROUNDING_M))
            if len(outside) and (earliest is None or outside[0] < earliest.index):
                first = int(outside[0])
                earliest = Violation(first, code, text.format(f"{-1e3 * there[first]:.0f}"))
        return earliest


def _joint_placements() -> np.ndarray:
    """Return (6, 4, 4) the pose of each arm joint's frame in its parent link at angle 0 (URDF); it turns about its axis
    of `AXES`."""
    from hal.base.z1_model import joint_placements
    from hal.servo.guard_kernels import AXES

    placements, axes = joint_placements()
    assert axes == tuple(AXES), f"the joints turn about {axes}, the compiled guard assumes {AXES}"
    return placements

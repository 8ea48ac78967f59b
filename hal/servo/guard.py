"""Where the arm may be, whoever commands it: inside a box, above the table, and clear of itself.

Trajectories are checked point by point before they are queued; single setpoints when they are taken, and again every
tick at the place where the arm would come to rest if it braked now.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError

_SLACK_M = 1e-3  # an arm that rests on the edge may be told to stay there
_ROUNDING_M = 1e-9  # more, and repeated attempts would creep outwards


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Where the hand may be, in the base frame; the defaults leave the arm all it can reach above its own table."""

    lower_m: tuple[float, float, float] = (-0.9, -0.9, -0.5)
    """Lower corner of a box for every point of the hand [m]."""
    upper_m: tuple[float, float, float] = (0.9, 0.9, 1.2)
    """Upper corner [m]."""
    table_m: float = -0.002
    """No point of hand or links goes below this height [m]; the base stands on z = 0."""
    self_m: float = -0.020
    """Least distance between the arm's parts, as this coarse model has them [m]: its capsules are up to 10 mm fatter
    than the links, and overlap by 13 mm where the folded arm rests on itself."""

    def __post_init__(self) -> None:
        numbers = (*self.lower_m, *self.upper_m, self.table_m, self.self_m)
        if not np.isfinite(numbers).all() or any(a >= b for a, b in zip(self.lower_m, self.upper_m, strict=True)):
            raise InvalidValueError(f"{self} must be finite, and lower_m below upper_m along every axis.")


class Margins(NamedTuple):
    """How far postures stay inside what is allowed; negative is outside."""

    box_m: np.ndarray
    """(N,) from the hand to the nearest side of the box [m]."""
    table_m: np.ndarray
    """(N,) from the lowest point of hand and links to the table [m]."""
    self_m: np.ndarray
    """(N,) between the two nearest parts of the arm, beyond the least distance [m]."""


_WHAT = (
    "takes the hand {} mm out of the workspace box",
    "goes {} mm below the table's plane",
    "brings parts of the arm {} mm too near to each other",
)


class Guard:
    """Knows the arm's kinematics and shape; holds no state, so any thread may ask it."""

    def __init__(self, workspace: Workspace | None = None) -> None:
        self.workspace = workspace or Workspace()
        from hal.servo.guard_kernels import (
            measure_margins,  # Numba takes long to load: nobody waits for it before he must
        )

        self._measure = measure_margins
        self._corners = np.array(self.workspace.lower_m), np.array(self.workspace.upper_m)
        self._joints = _joint_placements()
        self.margins(np.zeros((1, z1.N_JOINTS)))  # compiled before anything moves

    def margins(self, q: np.ndarray) -> Margins:
        """Return how far postures `q` (N, 7) [rad] stay inside; some microseconds each."""
        # A copy, writable: a read-only array is another type to the compiler, which would compile again in motion.
        q = np.array(q, dtype=np.float64, order="C")
        box, table, own = self._measure(q, self._joints, *self._corners, z1.T_FLANGE_PIVOT)
        space = self.workspace
        return Margins(box, table - space.table_m, own - space.self_m)

    def refusal(self, q: np.ndarray, q_now: np.ndarray) -> tuple[int, str] | None:
        """Return the first of `q` (N, 7) that is outside and why, or None.

        An arm that is outside already, at `q_now` (7,), may move as long as it does not get further out: else it
        could never be brought back.
        """
        now, asked = self.margins(q_now[None]), self.margins(q)
        worst: tuple[int, str] | None = None
        for here, there, what in zip(now, asked, _WHAT, strict=True):
            outside = np.flatnonzero(there < min(-_SLACK_M, float(here[0]) - _ROUNDING_M))
            if len(outside) and (worst is None or outside[0] < worst[0]):
                first = int(outside[0])
                worst = first, what.format(f"{-1e3 * there[first]:.0f}")
        return worst


def _joint_placements() -> np.ndarray:
    """Return (6, 4, 4) the pose of each arm joint's frame in its parent link at angle 0 (URDF); it turns about its axis
    of `AXES`."""
    from hal.base.z1_model import joint_placements
    from hal.servo.guard_kernels import AXES

    placements, axes = joint_placements()
    assert axes == tuple(AXES), f"the joints turn about {axes}, the compiled guard assumes {AXES}"
    return placements

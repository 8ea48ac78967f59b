"""What the stages of a pick hand to each other; each is made once and never changed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import Detection

IkMethod = Literal["analytic", "least_squares"]
"""How joints were found: exactly, or within 2 mm and 1° of the pose."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plane:
    """The table: all p with `normal @ p = offset_m`, in the frame its owner names."""

    normal: np.ndarray
    """(3,) unit vector, out of the table towards the camera."""
    offset_m: float
    """Signed distance of the plane from the origin along `normal` [m]."""

    def height_m(self, points: np.ndarray) -> np.ndarray:
        """Return the (N,) heights [m] of `points` (N, 3) above the plane."""
        return points @ self.normal - self.offset_m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observation:
    """What perception makes of one frame. Clouds and plane are in the camera's optical frame [m]."""

    frame: RgbdFrame
    T_base_camera: np.ndarray
    """(4, 4) camera pose when the frame was taken."""
    detection: Detection
    """The object that was chosen."""
    object_points: np.ndarray
    """(N, 3) the object, outliers and table taken off."""
    scene_points: np.ndarray
    """(M, 3) everything else that was seen: the table, neighbours, walls; not the object."""
    table: Plane
    occluded_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(K, 3) where the object may go on, but its sight was blocked; see `z1_runtime.perception.occlusion`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointTrajectory:
    """A timed path of the six arm joints and the gripper, sampled at the control period."""

    t_s: np.ndarray
    """(N,) times from the start [s], the first 0."""
    q: np.ndarray
    """(N, 7) positions [rad]."""
    dq: np.ndarray
    """(N, 7) velocities [rad/s]."""

    @property
    def duration_s(self) -> float:
        """How long it takes [s]."""
        return float(self.t_s[-1])

    def pieces(self, length_s: float) -> Iterator[slice]:
        """Yield index ranges that each span about `length_s` [s], in order, covering everything once."""
        start = 0
        while start < len(self.t_s):
            stop = int(np.searchsorted(self.t_s, self.t_s[start] + length_s, side="right"))
            yield slice(start, stop)
            start = stop


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """Why a candidate was not taken."""

    rank: int
    """Place of the candidate in the ranking, from 0."""
    reason: str
    """One word a table can count: `ik`, `path`, `table`, `scene`, `self`, `object`, `width`."""
    detail: str
    """The sentence a person reads, with the figures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspPlan:
    """One grasp the arm can do, with the whole motion."""

    rank: int
    """Place of the executed candidate in the ranking, from 0."""
    T_base_grasp: np.ndarray
    """(4, 4) the candidate, paper's grasp frame (z approach, y opening)."""
    width_m: float
    """Object width between the jaws [m]."""
    T_base_pivot: np.ndarray
    """(4, 4) gripper pivot at the grasp, where the joints really put it."""
    jaw_open: float
    """Mover angle while approaching [rad]."""
    jaw_contact: float
    """Mover angle at which the moving jaw should touch [rad]."""
    transfer: JointTrajectory
    """From where the arm is to the pre-grasp, jaw opening on the way."""
    approach: JointTrajectory
    """Straight from the pre-grasp to the grasp."""
    close: JointTrajectory
    """The jaw from open to past contact, the hand turning the other way until both jaws press; then the jaw alone:
    the servo's stiffness makes the squeeze."""
    lift: JointTrajectory
    """Straight up with the object from where the jaws closed, jaw command closed."""
    rejections: tuple[Rejection, ...]
    """Why the other candidates tried were refused: those before this one, and after least squares all others."""
    ik_method: IkMethod = "analytic"
    """How its joints were found; `least_squares` only after all candidates were refused with analytic ones."""

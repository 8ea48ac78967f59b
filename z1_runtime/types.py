"""Frozen values that the stages of a pick pass to each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import Detection

IkMethod = Literal["analytic", "least_squares"]
"""Solver of the joints: exact, or within 2 mm and 1° of the pose."""


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
    """One object and its surroundings in one frame. Clouds and plane are in the camera's optical frame [m]."""

    frame: RgbdFrame
    T_base_camera: np.ndarray
    """(4, 4) camera pose when the frame was taken."""
    detection: Detection
    """The object that was chosen."""
    object_points: np.ndarray
    """(N, 3) the object, without outliers and table."""
    scene_points: np.ndarray
    """(M, 3) everything else that was observed: the table, neighbours, walls; not the object."""
    table: Plane
    occluded_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(K, 3) where the object may continue behind an occlusion; see `z1_runtime.perception.detectors.yolo`."""


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
        """Time of the last sample [s]."""
        return float(self.t_s[-1])

    def split(self, length_s: float) -> Iterator[slice]:
        """Yield index ranges that each span about `length_s` [s], in order, covering everything once."""
        start = 0
        while start < len(self.t_s):
            stop = int(np.searchsorted(self.t_s, self.t_s[start] + length_s, side="right"))
            yield slice(start, stop)
            start = stop


class RejectionReason(StrEnum):
    """Reason for which a candidate is not taken; the values are column names of stored episodes.

    Declared by progress: of several rejections of one candidate, the latest in this order is reported.
    """

    WIDTH = "width"
    IK = "ik"
    PATH = "path"
    TABLE = "table"
    SELF = "self"
    OBJECT = "object"
    SCENE = "scene"

    @property
    def progress(self) -> int:
        """Index in the order of declaration."""
        return tuple(RejectionReason).index(self)


class PlanningStage(StrEnum):
    """Step of the planning at which a candidate is rejected."""

    FIT = "fit"
    """Gripper fitted to the object's width."""
    GRASP = "grasp"
    """Opened gripper at the grasp."""
    IK = "ik"
    """Joints of pre-grasp, grasp and lifted pose."""
    TRANSFER = "transfer"
    APPROACH = "approach"
    CLOSE = "close"
    LIFT = "lift"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """One candidate, posture or motion that is not taken, from the check to the report."""

    reason: RejectionReason
    stage: PlanningStage
    detail: str
    """A sentence with the figures."""
    rank: int | None = None
    """Index of the candidate in the ranking, from 0; None for what is no candidate, as in a calibration."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspPlan:
    """One feasible grasp with its whole motion."""

    rank: int
    """Index of the executed candidate in the ranking, from 0."""
    T_base_grasp: np.ndarray
    """(4, 4) the candidate, paper's grasp frame (z approach, y opening)."""
    width_m: float
    """Object width between the jaws [m]."""
    T_base_pivot: np.ndarray
    """(4, 4) gripper pivot at the grasp, as the planned joints reach it."""
    jaw_open: float
    """Jaw angle while approaching [rad]."""
    jaw_contact: float
    """Jaw angle at which the moving jaw should touch [rad]."""
    transfer: JointTrajectory
    """From the arm's present posture to the pre-grasp, the jaw opening meanwhile."""
    approach: JointTrajectory
    """Straight from the pre-grasp to the grasp."""
    close: JointTrajectory
    """The jaw from open to past contact, the gripper turning the other way until both jaws press; then the jaw alone:
    the servo's stiffness makes the squeeze."""
    lift: JointTrajectory
    """Straight up with the object, jaw command closed."""
    rejections: tuple[Rejection, ...]
    """One for each candidate that was tried and not taken: those before this one, and after least squares all
    others."""
    ik_method: IkMethod = "analytic"
    """Solver of its joints; `least_squares` only after all candidates were rejected with analytic ones."""

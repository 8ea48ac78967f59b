"""Mapping of a parallel-jaw grasp and a width to the Z1's gripper.

The gripper is a beak: one stationary jaw, and a moving jaw that turns about the pivot's y axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import Z1Error
from hal.base.z1 import moving_jaw_pose
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig, JawFit, fit_jaws
from z1_runtime.types import PlanningStage, Rejection, RejectionReason

_WIDTHS_M = np.arange(0.002, 0.120, 0.0005)
_PLACEHOLDER_WIDTH_M = 0.05  # keeps the arithmetic finite for widths that are rejected


class WidthError(Z1Error, ValueError):
    """An object too wide for the gripper, or a width that is not a positive number."""

    default_code = "width"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GripperPlacement:
    """Gripper at one grasp, in one of its two roll-flips."""

    T_base_grasp: np.ndarray
    """(4, 4) the grasp."""
    T_base_pivot: np.ndarray
    """(4, 4) pivot pose at the grasp, before the jaw closes."""
    jaw_open: float
    """Jaw angle while approaching [rad]."""
    jaw_contact: float
    """Jaw angle at which both jaws touch an object of that width [rad]."""
    T_base_touch: np.ndarray
    """(4, 4) pivot pose once both jaws press: turned about the jaw's axis, the object unmoved."""
    jaw_touch: float
    """Jaw angle there [rad]."""
    width_m: float
    """Object width [m]."""
    flipped: bool
    """False: the moving jaw is on the grasp's +y side; True: on its −y side."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GripperFits:
    """Fits of the gripper to N grasps, both flips each; every jaw angle is inside the gripper's limits."""

    T_base_pivots: np.ndarray
    """(N, 2, 4, 4) pivot poses; the second is flipped."""
    jaw_contact: np.ndarray
    """(N,) [rad]."""
    jaw_open: np.ndarray
    """(N,) [rad]."""
    T_base_touches: np.ndarray
    """(N, 2, 4, 4) pivot poses once both jaws press."""
    jaw_touch: np.ndarray
    """(N,) [rad]."""
    setback_m: np.ndarray
    """(N,) distance of the object before the requested contacts, so that the palm stays clear of it [m]."""
    level: np.ndarray
    """(N,) 1 where the squeeze does not push the object out, 0 where friction only just holds it."""
    fits: np.ndarray
    """(N,) False where the width is rejected; the other rows of such a grasp mean nothing."""


class BeakGripper:
    """Fits the gripper to objects of given width; independent of arm and scene."""

    def __init__(self, config: GripperPlacementConfig | None = None) -> None:
        self.config = config or GripperPlacementConfig()
        # Half angle of the friction cone
        self._max_squeeze_out = float(np.arctan(self.config.friction))
        fits = self._is_feasible(fit_jaws(_WIDTHS_M, 0.5 * _WIDTHS_M, self.config))
        self.max_width_m = float(_WIDTHS_M[fits].max(initial=0.0))
        """Widest round object that is neither squeezed out nor needs more than the full opening [m]."""

    def squeeze_out_angle(self, width_m: float) -> float:
        """Return the angle [rad] that friction has to hold at each jaw; negative when the squeeze pulls inwards."""
        width = np.array([width_m])
        return float(fit_jaws(width, 0.5 * width, self.config).squeeze_out[0])

    def fit(
        self, T_base_grasp: np.ndarray, width_m: float, front_m: float | None = None
    ) -> tuple[GripperPlacement, GripperPlacement]:
        """Fit the gripper to an object of `width_m` at `T_base_grasp` (4, 4), both roll-flips.

        The contact axis runs along the grasp's y, `contact_depth_m` before the origin: there is the centre of a disc
        of diameter `width_m` that both jaws touch. The fingertips pass it by 20 to 26 mm where the object leaves room
        before the palm, and by less where not.

        Args:
            T_base_grasp: (4, 4) the grasp: z approach, y opening, origin midway between a generator's fingertips.
            width_m: object's width along y [m].
            front_m: extent of the object from the contact axis towards the palm [m]; half the width if None.

        Raises:
            WidthError: the object is too wide or too deep, or its width is not a positive number.
        """
        front = None if front_m is None else np.array([front_m])
        fits = self.fit_batch(T_base_grasp[None], np.array([width_m]), front)
        if not fits.fits[0]:
            raise WidthError(self.reject_width(width_m, front_m).detail)
        one, other = (make_placement(fits, 0, flip, T_base_grasp, width_m) for flip in range(2))
        return one, other

    def reject_width(self, width_m: float, front_m: float | None = None) -> Rejection:
        """Return the rejection of an object of `width_m` that reaches `front_m` towards the palm."""
        if not width_m > 0.0:
            detail = f"the width is {width_m} m; it must be a positive number."
        else:
            deep = "" if front_m is None else f" and reaches {front_m * 1e3:.0f} mm from the contacts towards the palm"
            detail = (
                f"the object is {width_m * 1e3:.0f} mm wide{deep}; with a friction coefficient of "
                f"{self.config.friction} the gripper holds a round one of up to {self.max_width_m * 1e3:.0f} mm, and "
                f"one that reaches deep into it up to {self.config.max_setback_m * 1e3:.0f} mm nearer its front than "
                "requested."
            )
        return Rejection(reason=RejectionReason.WIDTH, stage=PlanningStage.FIT, detail=detail)

    def fit_batch(
        self, T_base_grasps: np.ndarray, widths_m: np.ndarray, fronts_m: np.ndarray | None = None
    ) -> GripperFits:
        """Fit the gripper to many objects: grasps (N, 4, 4), widths (N,) and fronts (N,) as in `fit` [m]."""
        usable = (widths_m > 0.0) & (widths_m < _WIDTHS_M[-1])
        widths = np.where(usable, widths_m, _PLACEHOLDER_WIDTH_M)
        fronts = 0.5 * widths if fronts_m is None else fronts_m
        jaw_fit = fit_jaws(widths, fronts, self.config)
        T_grasp_pivot = _grasp_to_pivot(jaw_fit.centre, jaw_fit.tilt)
        T_grasp_pivot[:, 2, 3] -= self.config.contact_depth_m + jaw_fit.setback_m
        # The same grasp to a parallel gripper; here stationary and moving jaw change sides
        flip = np.diag([-1.0, -1.0, 1.0, 1.0])
        T_base_pivots = np.stack([T_base_grasps @ T_grasp_pivot, T_base_grasps @ flip @ T_grasp_pivot], axis=1)
        return GripperFits(
            T_base_pivots=T_base_pivots,
            jaw_contact=_clip_jaw(-jaw_fit.contact),
            jaw_open=_clip_jaw(-jaw_fit.opened),
            T_base_touches=T_base_pivots @ moving_jaw_pose(-jaw_fit.turn)[:, None],
            jaw_touch=_clip_jaw(-jaw_fit.pressed),
            setback_m=jaw_fit.setback_m,
            level=np.clip(1.0 - jaw_fit.squeeze_out / self._max_squeeze_out, 0.0, 1.0),
            fits=usable & self._is_feasible(jaw_fit),
        )

    def _is_feasible(self, jaw_fit: JawFit) -> np.ndarray:
        held = (jaw_fit.squeeze_out <= self._max_squeeze_out) & (jaw_fit.setback_m <= self.config.max_setback_m)
        # Openings are positive, jaw angles negative
        return held & (jaw_fit.opened <= -z1.GRIPPER_OPEN)


def make_placement(fits: GripperFits, n: int, flip: int, T_base_grasp: np.ndarray, width_m: float) -> GripperPlacement:
    """Return flip 0 or 1 of fit `n` for the grasp `T_base_grasp` (4, 4) of an object of `width_m` [m]."""
    return GripperPlacement(
        T_base_grasp=T_base_grasp,
        T_base_pivot=fits.T_base_pivots[n, flip],
        jaw_open=float(fits.jaw_open[n]),
        jaw_contact=float(fits.jaw_contact[n]),
        T_base_touch=fits.T_base_touches[n, flip],
        jaw_touch=float(fits.jaw_touch[n]),
        width_m=float(width_m),
        flipped=bool(flip),
    )


def _clip_jaw(angles: np.ndarray) -> np.ndarray:
    """Return jaw angles inside the limits.

    A squeeze wider than a thin object asks for up to 0.0017 rad beyond closed, where the measured faces meet.
    """
    return np.clip(angles, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED)


def _grasp_to_pivot(centre: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Return T_grasp_pivot (N, 4, 4) of grasps at `centre` (N, 2) in the pivot's xz plane.

    `tilt` (N,) is their approach's angle from x towards z [rad].
    """
    c, s = np.cos(tilt), np.sin(tilt)
    x, z = centre.T
    T = np.zeros((len(x), 4, 4))
    # Rows are the grasp's axes in the pivot frame: x along the pads' width, y from the stationary to the moving jaw
    T[:, 0, 1] = T[:, 3, 3] = 1.0
    T[:, 1, 0], T[:, 1, 2] = -s, c
    T[:, 2, 0], T[:, 2, 2] = c, s
    T[:, 1, 3] = s * x - c * z
    T[:, 2, 3] = -(c * x + s * z)
    return T

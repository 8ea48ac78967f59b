"""Maps a parallel-jaw grasp and a width to the Z1's beak: one fixed jaw, one that turns about the pivot's y axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base import z1
from hal.base.errors import Z1Error
from hal.base.z1_gripper import moving_jaw_pose
from z1_runtime.geometry.gripper_geometry import BeakConfig, Lay, lay_around

_WIDTHS_M = np.arange(0.002, 0.120, 0.0005)


class WidthError(Z1Error, ValueError):
    """An object is too wide for the beak, or its width makes no sense."""

    default_code = "width"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BeakGrasp:
    """One way to lay the beak around an object."""

    T_base_pivot: np.ndarray
    """(4, 4) pivot pose at the grasp, before the jaw closes."""
    jaw_contact: float
    """Mover angle at which both jaws touch an object of that width [rad]."""
    jaw_open: float
    """Mover angle while approaching [rad]."""
    T_base_touch: np.ndarray
    """(4, 4) pivot pose once both jaws press: turned about the jaw's axis, the object where it was."""
    jaw_touch: float
    """Mover angle there [rad]."""
    width_m: float
    """Object width [m]."""
    flipped: bool
    """False: the moving jaw is on the grasp's +y side; True: on its −y side."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BeakBatch:
    """Both ways for many grasps."""

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
    """(N,) how far before the asked contacts the object is held, so that the palm stays clear of it [m]."""
    level: np.ndarray
    """(N,) 1 where the squeeze does not push the object out, 0 where friction only just holds it."""
    fits: np.ndarray
    """(N,) False where the width is refused; the other rows of such a grasp mean nothing."""


class BeakGripper:
    """Lays the beak around objects of given width; knows nothing of arm or scene."""

    def __init__(self, config: BeakConfig | None = None) -> None:
        self.config = config or BeakConfig()
        self._steepest = float(np.arctan(self.config.friction))
        fits = self._fits(lay_around(_WIDTHS_M, 0.5 * _WIDTHS_M, self.config))
        self.max_width_m = float(_WIDTHS_M[fits].max(initial=0.0))
        """Widest round object that is neither squeezed out nor needs more than the full opening [m]."""

    def squeeze_out_angle(self, width_m: float) -> float:
        """Return the angle [rad] friction must make up for at each jaw; negative when the squeeze pulls inwards."""
        width = np.array([width_m])
        return float(lay_around(width, 0.5 * width, self.config).squeeze_out[0])

    def fit(
        self, T_base_grasp: np.ndarray, width_m: float, front_m: float | None = None
    ) -> tuple[BeakGrasp, BeakGrasp]:
        """Lay the beak around an object of `width_m` at `T_base_grasp` (4, 4), both roll-flips.

        The contact axis runs along the grasp's y, `contact_depth_m` before the origin: there is the middle of a disc
        of diameter `width_m` that both jaws touch. The fingertips pass it by 20 to 26 mm where the object leaves room
        before the palm, and by less where not.

        Args:
            T_base_grasp: (4, 4) the grasp: z approach, y opening, origin midway between a generator's fingertips.
            width_m: object's width along y [m].
            front_m: how far the object reaches from the contact axis towards the palm [m]; half the width if None.

        Raises:
            WidthError: the object is too wide or too deep, or its width is not a positive number.
        """
        front = None if front_m is None else np.array([front_m])
        batch = self.fit_batch(T_base_grasp[None], np.array([width_m]), front)
        if not batch.fits[0]:
            raise WidthError(self.refusal(width_m, front_m))
        one, other = (
            BeakGrasp(
                T_base_pivot=batch.T_base_pivots[0, flip],
                jaw_contact=float(batch.jaw_contact[0]),
                jaw_open=float(batch.jaw_open[0]),
                T_base_touch=batch.T_base_touches[0, flip],
                jaw_touch=float(batch.jaw_touch[0]),
                width_m=float(width_m),
                flipped=bool(flip),
            )
            for flip in range(2)
        )
        return one, other

    def refusal(self, width_m: float, front_m: float | None = None) -> str:
        """Say why an object of `width_m` that reaches `front_m` towards the palm does not fit."""
        if not width_m > 0.0:
            return f"the width is {width_m} m; it must be a positive number."
        deep = "" if front_m is None else f" and reaches {front_m * 1e3:.0f} mm from the contacts towards the palm"
        return (
            f"the object is {width_m * 1e3:.0f} mm wide{deep}; with a friction coefficient of {self.config.friction} "
            f"the beak holds a round one of up to {self.max_width_m * 1e3:.0f} mm, and one that reaches deep into "
            f"the hand up to {self.config.max_setback_m * 1e3:.0f} mm nearer its front than asked."
        )

    def fit_batch(
        self, T_base_grasps: np.ndarray, widths_m: np.ndarray, fronts_m: np.ndarray | None = None
    ) -> BeakBatch:
        """Lay the beak around many objects: grasps (N, 4, 4), widths (N,) and fronts (N,) as in `fit` [m]."""
        usable = (widths_m > 0.0) & (widths_m < _WIDTHS_M[-1])
        widths = np.where(usable, widths_m, 0.05)
        fronts = 0.5 * widths if fronts_m is None else fronts_m
        lay = lay_around(widths, fronts, self.config)
        T_grasp_pivot = _grasp_to_pivot(lay.centre, lay.tilt)
        T_grasp_pivot[:, 2, 3] -= self.config.contact_depth_m + lay.setback_m
        flip = np.diag([-1.0, -1.0, 1.0, 1.0])
        T_base_pivots = np.stack([T_base_grasps @ T_grasp_pivot, T_base_grasps @ flip @ T_grasp_pivot], axis=1)
        return BeakBatch(
            T_base_pivots=T_base_pivots,
            jaw_contact=-lay.contact,
            jaw_open=np.maximum(-lay.opened, z1.GRIPPER_OPEN),
            T_base_touches=T_base_pivots @ moving_jaw_pose(-lay.turn)[:, None],
            jaw_touch=-lay.pressed,
            setback_m=lay.setback_m,
            level=np.clip(1.0 - lay.squeeze_out / self._steepest, 0.0, 1.0),
            fits=usable & self._fits(lay),
        )

    def _fits(self, lay: Lay) -> np.ndarray:
        held = (lay.squeeze_out <= self._steepest) & (lay.setback_m <= self.config.max_setback_m)
        return held & (lay.opened <= -z1.GRIPPER_OPEN)


def _grasp_to_pivot(centre: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Return T_grasp_pivot (N, 4, 4) of grasps at `centre` (N, 2) in the pivot's xz plane.

    `tilt` (N,) is their approach's angle from x towards z [rad].
    """
    c, s = np.cos(tilt), np.sin(tilt)
    x, z = centre.T
    T = np.zeros((len(x), 4, 4))
    # Rows are the grasp's axes in the pivot frame: x along the pads' width, y from the fixed jaw to the mover
    T[:, 0, 1] = T[:, 3, 3] = 1.0
    T[:, 1, 0], T[:, 1, 2] = -s, c
    T[:, 2, 0], T[:, 2, 2] = c, s
    T[:, 1, 3] = s * x - c * z
    T[:, 2, 3] = -(c * x + s * z)
    return T

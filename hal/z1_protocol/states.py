"""States of the vendor's controller: their numbers on the wire, and the transitions between them."""

from __future__ import annotations

from enum import IntEnum


class Fsm(IntEnum):
    """State of the controller, numbered as on the wire (measured; the vendor's Python stub has other numbers)."""

    INVALID = 0
    """No state change requested."""
    PASSIVE = 1
    """Damped, without stiffness: the arm sinks."""
    JOINTCTRL = 2
    """Holds, or tracks joint positions while `track` is set."""
    CARTESIAN = 3
    """Holds, or follows a twist while `track` is set."""
    MOVEJ = 4
    MOVEL = 5
    MOVEC = 6
    TRAJECTORY = 7
    """Runs a built-in demonstration, over and over."""
    TOSTATE = 8
    """Moves to a saved label."""
    SAVESTATE = 9
    """Saves the pose under a label."""
    TEACH = 10
    """Records while the arm is guided by hand."""
    TEACHREPEAT = 11
    """Plays such a recording."""
    CALIBRATION = 12
    """Makes the present pose the zero of the joints."""
    SETTRAJ = 13
    """Without effect."""
    BACKTOSTART = 14
    """Moves to `startFlat`."""
    NEXT = 15
    """Ends TRAJECTORY by BACKTOSTART."""
    LOWCMD = 16
    """Forwards torques, positions and gains to the motors."""


MOVES = frozenset(
    {
        Fsm.MOVEJ,
        Fsm.MOVEL,
        Fsm.MOVEC,
        Fsm.TRAJECTORY,
        Fsm.TOSTATE,
        Fsm.SAVESTATE,
        Fsm.TEACHREPEAT,
        Fsm.BACKTOSTART,
    }
)
"""States in which the controller moves (or saves) by itself; done, it falls back to JOINTCTRL."""

_HOMING = frozenset({Fsm.PASSIVE, Fsm.JOINTCTRL, Fsm.BACKTOSTART})
_CARTESIAN_MOVES = frozenset({Fsm.MOVEJ, Fsm.MOVEL, Fsm.MOVEC})
_FROM_CARTESIAN_MOVE = _HOMING | _CARTESIAN_MOVES | {Fsm.CARTESIAN, Fsm.SAVESTATE}
_NONE: frozenset[Fsm] = frozenset()
# Every pair was tried on the vendor's controller. A replayed lesson cannot be interrupted, not even by PASSIVE.
_GRANTED = {
    Fsm.PASSIVE: frozenset({Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.BACKTOSTART, Fsm.LOWCMD, Fsm.CALIBRATION}),
    Fsm.JOINTCTRL: MOVES | {Fsm.PASSIVE, Fsm.CARTESIAN, Fsm.TEACH},
    Fsm.CARTESIAN: _HOMING | _CARTESIAN_MOVES | {Fsm.TOSTATE, Fsm.SAVESTATE},
    Fsm.MOVEJ: _FROM_CARTESIAN_MOVE,
    Fsm.MOVEL: _FROM_CARTESIAN_MOVE,
    Fsm.MOVEC: _FROM_CARTESIAN_MOVE,
    Fsm.TRAJECTORY: _HOMING | {Fsm.NEXT},
    Fsm.TOSTATE: _HOMING,
    Fsm.TEACH: _HOMING,
    Fsm.BACKTOSTART: _HOMING,
    Fsm.LOWCMD: _HOMING,
}


def is_granted(present: Fsm, requested: Fsm) -> bool:
    """Return whether the controller, in state `present`, grants a request for `requested`; else it ignores it.

    Measured on the vendor's controller, every pair. NEXT during TRAJECTORY acts as BACKTOSTART.
    """
    return requested in (present, Fsm.INVALID) or requested in _GRANTED.get(present, _NONE)

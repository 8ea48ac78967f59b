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
    """Holds, or tracks a pose while `track` is set."""
    MOVEJ = 4
    MOVEL = 5
    MOVEC = 6
    TRAJECTORY = 7
    TOSTATE = 8
    """Moves to a saved label."""
    SAVESTATE = 9
    """Saves the pose under a label."""
    TEACH = 10
    """Records while the arm is guided by hand."""
    TEACHREPEAT = 11
    """Plays such a recording."""
    CALIBRATION = 12
    SETTRAJ = 13
    BACKTOSTART = 14
    """Moves to `startFlat`."""
    NEXT = 15
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

_FROM_PASSIVE = {Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.BACKTOSTART, Fsm.LOWCMD, Fsm.CALIBRATION}
_FROM_LOWCMD = {Fsm.JOINTCTRL, Fsm.PASSIVE, Fsm.BACKTOSTART}
_FROM_MOVING = {Fsm.JOINTCTRL, Fsm.PASSIVE, Fsm.BACKTOSTART}
_FROM_CARTESIAN = (MOVES - {Fsm.TEACHREPEAT}) | {Fsm.PASSIVE, Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.SETTRAJ}
_FROM_JOINTCTRL = _FROM_CARTESIAN | {Fsm.TEACH, Fsm.TEACHREPEAT}


def is_granted(present: Fsm, requested: Fsm) -> bool:
    """Return whether the controller, in state `present`, grants a request for `requested`; else it ignores it.

    Measured on the vendor's controller, except for moves from CARTESIAN and for JOINTCTRL or PASSIVE out of a move,
    which the vendor's examples use.
    """
    if requested in (present, Fsm.INVALID):
        return True
    match present:
        case Fsm.PASSIVE:
            return requested in _FROM_PASSIVE
        case Fsm.LOWCMD:
            return requested in _FROM_LOWCMD
        case Fsm.JOINTCTRL:
            return requested in _FROM_JOINTCTRL
        case Fsm.CARTESIAN:
            return requested in _FROM_CARTESIAN
        case _:
            return requested in _FROM_MOVING

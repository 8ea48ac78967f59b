"""States of the vendor's controller: their numbers on the wire, and which may be asked for from which."""

from __future__ import annotations

from enum import IntEnum


class Fsm(IntEnum):
    """What the controller is doing; the numbers are those on the wire (the vendor's Python stub has others)."""

    INVALID = 0
    """In a command: keep what you are."""
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
    """Records while somebody moves the arm by hand."""
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
_FROM_LOWCMD = {Fsm.JOINTCTRL, Fsm.PASSIVE}
_FROM_MOVING = {Fsm.JOINTCTRL, Fsm.PASSIVE}
_FROM_HOLDING = MOVES | {Fsm.PASSIVE, Fsm.JOINTCTRL, Fsm.CARTESIAN, Fsm.TEACH, Fsm.SETTRAJ}


def granted(now: Fsm, asked: Fsm) -> bool:
    """Whether the controller, being in `now`, follows a request for `asked`; else it stays where it is.

    Observed: everything about PASSIVE and LOWCMD, and that moves start from JOINTCTRL. Assumed from the vendor's
    examples, which do it: moves from CARTESIAN, and JOINTCTRL or PASSIVE out of a move or a teaching.
    """
    if asked in (now, Fsm.INVALID):
        return True
    match now:
        case Fsm.PASSIVE:
            return asked in _FROM_PASSIVE
        case Fsm.LOWCMD:
            return asked in _FROM_LOWCMD
        case Fsm.JOINTCTRL | Fsm.CARTESIAN:
            return asked in _FROM_HOLDING
        case _:
            return asked in _FROM_MOVING

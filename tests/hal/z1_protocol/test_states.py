"""The vendor's state machine, as it was measured."""

from __future__ import annotations

import pytest

from hal.z1_protocol.states import MOVES, Fsm, is_granted


@pytest.mark.parametrize(
    ("present", "requested", "expected"),
    [
        (Fsm.PASSIVE, Fsm.JOINTCTRL, True),
        (Fsm.PASSIVE, Fsm.CARTESIAN, True),
        (Fsm.PASSIVE, Fsm.BACKTOSTART, True),
        (Fsm.PASSIVE, Fsm.LOWCMD, True),
        (Fsm.PASSIVE, Fsm.MOVEJ, False),
        (Fsm.JOINTCTRL, Fsm.LOWCMD, False),
        (Fsm.CARTESIAN, Fsm.LOWCMD, False),
        (Fsm.LOWCMD, Fsm.JOINTCTRL, True),
        (Fsm.LOWCMD, Fsm.PASSIVE, True),
        (Fsm.LOWCMD, Fsm.MOVEJ, False),
        (Fsm.JOINTCTRL, Fsm.MOVEJ, True),
        (Fsm.JOINTCTRL, Fsm.TOSTATE, True),
        (Fsm.CARTESIAN, Fsm.BACKTOSTART, True),
        (Fsm.MOVEJ, Fsm.JOINTCTRL, True),
        (Fsm.MOVEJ, Fsm.MOVEL, True),
        (Fsm.MOVEJ, Fsm.TOSTATE, False),
        (Fsm.TEACH, Fsm.JOINTCTRL, True),
        (Fsm.TEACH, Fsm.BACKTOSTART, True),
        (Fsm.TOSTATE, Fsm.BACKTOSTART, True),
        (Fsm.LOWCMD, Fsm.BACKTOSTART, True),
        (Fsm.CARTESIAN, Fsm.TEACH, False),
        (Fsm.CARTESIAN, Fsm.TEACHREPEAT, False),
        (Fsm.CARTESIAN, Fsm.TRAJECTORY, False),
        (Fsm.TEACHREPEAT, Fsm.PASSIVE, False),
        (Fsm.TRAJECTORY, Fsm.NEXT, True),
    ],
)
def test_a_request_is_granted_as_the_controller_grants_it(present: Fsm, requested: Fsm, expected: bool) -> None:
    assert is_granted(present, requested) is expected


@pytest.mark.parametrize("state", list(Fsm))
def test_staying_is_always_granted(state: Fsm) -> None:
    assert is_granted(state, state)
    assert is_granted(state, Fsm.INVALID)


@pytest.mark.parametrize("state", sorted(MOVES - {Fsm.BACKTOSTART}))
def test_from_lowcmd_the_arm_moves_to_its_start_alone(state: Fsm) -> None:
    assert not is_granted(Fsm.LOWCMD, state)
    assert is_granted(Fsm.LOWCMD, Fsm.BACKTOSTART)

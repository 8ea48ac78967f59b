"""Every request in every state of a controller."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hal.z1_protocol.controller import LABELS, TrajectoryCommand
from hal.z1_protocol.states import Fsm
from tests.support.vendor.observations import Observation
from tests.support.vendor.probe import Body, Probe, move_from

_LESSON, _LESSON_S = "lesson", 1.0
_FROM_PASSIVE = (Fsm.PASSIVE, Fsm.LOWCMD)
_PRESENT = (
    *_FROM_PASSIVE,
    Fsm.JOINTCTRL,
    Fsm.CARTESIAN,
    Fsm.MOVEJ,
    Fsm.MOVEL,
    Fsm.MOVEC,
    Fsm.TOSTATE,
    Fsm.BACKTOSTART,
    Fsm.TEACH,
    Fsm.TEACHREPEAT,
    Fsm.TRAJECTORY,
)
_REQUESTED = tuple(state for state in Fsm if state is not Fsm.INVALID)
# A calibration changes what all later measurements mean.
_SKIPPED = {(Fsm.PASSIVE, Fsm.CALIBRATION)}


def observe_grants(probe: Probe) -> Iterator[Observation]:
    """Observe which requests each state grants."""
    _teach(probe)
    for present in _PRESENT:
        granted = []
        for requested in _REQUESTED:
            if requested is present or (present, requested) in _SKIPPED:
                continue
            _bring_to(probe, present)
            seen = probe.ask(requested, _body(probe, requested), hold_s=0.02)
            if requested.name in seen:
                granted.append(requested.name)
            elif seen[-1] != present.name:
                granted.append(f"{requested.name}→{seen[-1]}")
        yield Observation(f"granted in {present.name}", " ".join(granted))


def _teach(probe: Probe) -> None:
    probe.go(Fsm.JOINTCTRL)
    probe.move(Fsm.TOSTATE, "forward")
    probe.ask(Fsm.TEACH, _LESSON, hold_s=_LESSON_S)
    probe.go(Fsm.JOINTCTRL)


def _bring_to(probe: Probe, present: Fsm) -> None:
    if present in _FROM_PASSIVE:
        probe.go(Fsm.JOINTCTRL)
        if np.abs(probe.newest.joints.q[:6] - LABELS["startFlat"]).max() > 0.05:
            probe.move(Fsm.BACKTOSTART)  # there the arm rests on itself
        probe.go(Fsm.PASSIVE)
    else:
        probe.go(Fsm.JOINTCTRL)
        if np.abs(probe.newest.joints.q[:3] - LABELS["forward"][:3]).max() > 0.5:
            probe.move(Fsm.TOSTATE, "forward")
    if present not in (Fsm.PASSIVE, Fsm.JOINTCTRL):
        probe.ask(present, _body(probe, present), hold_s=0.02)
    if probe.fsm is not present:
        raise RuntimeError(f"the controller is in {probe.fsm.name} instead of {present.name}.")


def _body(probe: Probe, state: Fsm) -> Body:
    if state in (Fsm.MOVEJ, Fsm.MOVEL):
        return _slow_move(probe, (0, 0, 0, 0, 0, 0.08))
    if state is Fsm.MOVEC:
        return _slow_move(probe, (0, 0, 0, 0, 0.03, 0.03), (0, 0, 0, 0, 0, 0.06))
    if state is Fsm.TOSTATE:
        return "show_left"
    if state in (Fsm.SAVESTATE, Fsm.TEACH):
        return "scratch"
    return _LESSON if state is Fsm.TEACHREPEAT else None


def _slow_move(probe: Probe, *steps: tuple[float, ...]) -> TrajectoryCommand:
    """Return a move of the pivot, up below the middle of its reach and down above it."""
    up = 1.0 if probe.newest.pose[5] < 0.42 else -1.0
    return move_from(probe.newest.pose, *(tuple(up * value for value in step) for step in steps), speed=0.05)

"""Scripts for the vendor's Python module run on ours."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hal.compat.unitree_arm_interface as vendor
from hal.backends.z1.arm import Z1Arm
from hal.base import z1
from hal.base.clock import ManualClock, WallClock
from hal.base.errors import HalTimeoutError, InvalidMessageError
from hal.compat.unitree_arm_interface import ArmFSMState, ArmInterface
from hal.z1_protocol.controller import LABELS
from hal.z1_protocol.states import Fsm
from tests.support.errors import raises
from tests.support.hal.z1_peer import FakeController, MemoryLink, pivot_kinematics, serving

FORWARD = LABELS["forward"]


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock(10.0)


@pytest.fixture
def peer(clock: ManualClock) -> FakeController:
    peer = FakeController(clock)
    peer.rests = True
    return peer


@pytest.fixture
def arm(peer: FakeController, clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> Iterator[ArmInterface]:
    """An interface by the clock of the test, without a thread: the test calls `sendRecv` itself."""
    link = MemoryLink(peer, clock)
    monkeypatch.setattr(ArmInterface, "make_arm", staticmethod(lambda config: Z1Arm(clock, config, link=link)))
    arm = ArmInterface(hasGripper=True)
    yield arm
    arm._close()


def cycle(arm: ArmInterface, clock: ManualClock, times: int = 1) -> None:
    for _ in range(times):
        arm.sendRecv()
        clock.advance(arm._ctrlComp.dt)


def test_the_names_are_the_vendors() -> None:
    """Classes and members of the vendor's stub file and bindings."""
    for name in ("postureToHomo", "homoToPosture", "ArmFSMState", "LowlevelState", "CtrlComponents", "Z1Model"):
        assert hasattr(vendor, name)
    methods = (
        "setFsm setFsmLowcmd getCurrentState loopOn loopOff backToStart labelRun labelSave teach teachRepeat "
        "calibration MoveJ MoveL MoveC startTrack sendRecv setWait jointCtrlCmd cartesianCtrlCmd setArmCmd "
        "setGripperCmd"
    )
    arm = ArmInterface(True)
    for name in methods.split():
        assert callable(getattr(arm, name))
    for name in ["lowstate", "_ctrlComp", "q", "qd", "tau", "gripperQ", "gripperQd", "gripperTau"]:
        assert hasattr(arm, name)
    for name in ["getQ", "getQd", "getQdd", "getTau", "getQTau", "getGripperQ"]:
        assert callable(getattr(arm.lowstate, name))
    assert arm._ctrlComp.dt == 0.002
    assert isinstance(arm._ctrlComp.armModel, vendor.Z1Model)
    assert ArmFSMState.LOWCMD == 16


def test_it_is_imported_under_the_vendors_name_on_request() -> None:
    assert "unitree_arm_interface" not in sys.modules
    with vendor.masquerade():
        import unitree_arm_interface  # pyright: ignore[reportMissingImports]

        assert unitree_arm_interface is vendor
    assert "unitree_arm_interface" not in sys.modules


def test_a_label_is_run_from_passive_and_lowstate_is_updated(arm: ArmInterface, clock: ManualClock) -> None:
    assert arm.getCurrentState() is ArmFSMState.PASSIVE
    assert arm.labelRun("forward")
    cycle(arm, clock)
    assert arm.lowstate.getQ() == pytest.approx(FORWARD, abs=0.01)
    assert arm.lowstate.endPosture == pytest.approx([0, -0.040, 0, 0.4129, 0, 0.4069], abs=0.01)
    assert arm.getCurrentState() is ArmFSMState.JOINTCTRL
    assert len(arm.lowstate.temperature) == len(arm.lowstate.errorstate) == 8


def test_impossible_requests_return_false_and_are_logged(
    arm: ArmInterface, peer: FakeController, caplog: pytest.LogCaptureFixture
) -> None:
    assert not arm.labelRun("nowhere")
    assert "read the request for TOSTATE and refuses it" in caplog.text
    assert not arm.MoveJ(np.array([0, 0, 0, 2.0, 0, 0]), 1.0)
    assert "is unreachable within the joint limits" in caplog.text
    assert not arm.setFsm(ArmFSMState.LOWCMD)
    assert "Only PASSIVE can go to LOWCMD" in caplog.text
    arm.startTrack(ArmFSMState.TEACH)
    assert "startTrack takes" in caplog.text
    assert peer.fsm is Fsm.JOINTCTRL


@pytest.mark.integration
def test_moves_reach_their_goals_with_and_without_the_gripper(arm: ArmInterface, peer: FakeController) -> None:
    arm.labelRun("forward")
    assert arm.MoveJ(np.array([0.5, 0.1, 0.1, 0.5, -0.2, 0.5]), -1.0, 1.0)
    assert peer.pose() == pytest.approx([0.5, 0.1, 0.1, 0.5, -0.2, 0.5], abs=0.01)
    assert peer.q[6] == pytest.approx(-1.0, abs=0.01)
    assert arm.MoveL(np.array([0, 0, 0, 0.45, -0.2, 0.2]), 0.3)
    assert peer.pose() == pytest.approx([0, 0, 0, 0.45, -0.2, 0.2], abs=0.01)
    assert peer.q[6] == pytest.approx(-1.0, abs=0.01)
    assert arm.MoveC(np.array([0, 0, 0, 0.45, 0, 0.4]), [0, 0, 0, 0.45, 0.2, 0.2], 5.0, 99.0)
    assert peer.pose() == pytest.approx([0, 0, 0, 0.45, 0.2, 0.2], abs=0.01)
    sent = [c.trajectory() for c in peer.received if c.state is Fsm.MOVEC]
    assert sent[-1].gripper_rad == 0.0
    assert sent[-1].max_speed == 1.0
    with pytest.raises(TypeError):
        arm.MoveJ(np.zeros(6))


@pytest.mark.integration
def test_without_waiting_a_move_is_only_started(arm: ArmInterface, peer: FakeController, clock: ManualClock) -> None:
    arm.setWait(False)
    arm.labelRun("forward")
    assert arm.getCurrentState() is ArmFSMState.TOSTATE
    cycle(arm, clock, 1000)
    assert arm.getCurrentState() is ArmFSMState.JOINTCTRL
    assert peer.q[:6] == pytest.approx(FORWARD, abs=0.01)
    arm.setWait(True)
    arm.backToStart()
    assert peer.q[:6] == pytest.approx(LABELS["startFlat"], abs=0.01)


@pytest.mark.integration
def test_joints_are_jogged(arm: ArmInterface, peer: FakeController, clock: ManualClock) -> None:
    arm.labelRun("forward")
    arm.startTrack(ArmFSMState.JOINTCTRL)
    before = peer.q.copy()
    for _ in range(500):
        arm.jointCtrlCmd(np.array([0, 0, 0, -1, 0, 0, -1]), 0.5)
        cycle(arm, clock)
    assert peer.q - before == pytest.approx([0, 0, 0, -0.5, 0, 0, -0.5], abs=0.02)
    for _ in range(2000):
        arm.jointCtrlCmd([0, 0, 0, -1, 0, 0, 0], 99.0)
        cycle(arm, clock)
    assert peer.q[3] == pytest.approx(z1.Q_MIN[3], abs=1e-3)


@pytest.mark.integration
def test_a_far_target_is_approached_at_the_maximum_speed(
    arm: ArmInterface, peer: FakeController, clock: ManualClock
) -> None:
    arm.labelRun("forward")
    arm.startTrack(ArmFSMState.JOINTCTRL)
    arm.setArmCmd([5.0, 1.5, -1.0, -0.54, 0, 0], np.zeros(6))
    arm.setGripperCmd(-9.0, 0.0, 0.0)
    cycle(arm, clock, 100)
    assert 0.3 < peer.q[0] < 0.2 * np.pi + 0.01
    cycle(arm, clock, 900)
    assert peer.q[0] == pytest.approx(z1.Q_MAX[0], abs=1e-3)
    assert peer.q[6] == pytest.approx(z1.Q_MIN[6], abs=1e-3)


@pytest.mark.integration
def test_the_posture_is_jogged_and_stops_without_commands(
    arm: ArmInterface, peer: FakeController, clock: ManualClock
) -> None:
    arm.labelRun("forward")
    arm.startTrack(ArmFSMState.CARTESIAN)
    before = peer.pose()
    for _ in range(500):
        arm.cartesianCtrlCmd(np.array([0, 0, 0, 0, 0, -1, -1]), 0.3, 0.1)
        cycle(arm, clock)
        assert arm.getCurrentState() is ArmFSMState.CARTESIAN
    assert peer.pose() - before == pytest.approx([0, 0, 0, 0, 0, -0.1], abs=0.005)
    cycle(arm, clock, 500)
    rest = peer.pose()
    assert rest - before == pytest.approx([0, 0, 0, 0, 0, -0.15], abs=0.005)
    cycle(arm, clock, 500)
    assert peer.pose() == pytest.approx(rest, abs=1e-4)


@pytest.mark.integration
def test_low_level_commands_reach_the_motors_within_their_limits(
    arm: ArmInterface, peer: FakeController, clock: ManualClock
) -> None:
    arm.labelRun("forward")
    arm.setFsmLowcmd()
    assert arm.getCurrentState() is ArmFSMState.LOWCMD
    goal = FORWARD + 0.2 * np.eye(6)[0]
    start = arm.lowstate.getQ()
    for i in range(500):
        arm.q = start + (goal - start) * (i + 1) / 500
        arm.qd = (goal - start) / 1.0
        arm.tau = arm._ctrlComp.armModel.inverseDynamics(arm.q, arm.qd, np.zeros(6), np.zeros(6))
        arm.gripperQ = -0.5
        cycle(arm, clock)
    assert peer.q[:6] == pytest.approx(goal, abs=0.02)
    arm.tau = np.full(6, 700.0)
    cycle(arm, clock)
    assert (np.abs(peer.received[-1].joints().tau[:6]) <= z1.TAU_MAX[:6] + 1e-3).all()
    arm.tau = np.array([0, 0, np.nan, 0, 0, 0])
    with raises(InvalidMessageError, "invalid_message"):
        cycle(arm, clock)
    assert arm.backToStart()
    assert peer.q[:6] == pytest.approx(LABELS["startFlat"], abs=0.01)


def test_gains_of_the_low_level_mode_are_forwarded(arm: ArmInterface, peer: FakeController, clock: ManualClock) -> None:
    arm.setFsmLowcmd()
    arm._ctrlComp.lowcmd.setControlGain([1, 2, 3, 4, 5, 6], [10] * 6)
    arm._ctrlComp.lowcmd.setGripperZeroGain()
    cycle(arm, clock)
    assert peer.received[-1].joints().kp.tolist() == [1, 2, 3, 4, 5, 6, 0]
    arm._ctrlComp.lowcmd.setControlGain()
    cycle(arm, clock)
    assert peer.received[-1].joints().kp.tolist() == [20, 30, 30, 20, 15, 10, 0]


def test_teaching_continues_until_another_state_is_requested(arm: ArmInterface, peer: FakeController) -> None:
    assert arm.teach("mine")
    assert peer.fsm is Fsm.TEACH
    assert [c.label() for c in peer.received if c.state is Fsm.TEACH][-1] == "mine"
    assert arm.setFsm(ArmFSMState.JOINTCTRL)
    assert peer.fsm is Fsm.JOINTCTRL


SCRIPT = """
import sys, time
sys.path.append("../lib")
import numpy as np
import unitree_arm_interface

arm = unitree_arm_interface.ArmInterface(hasGripper=True)
state = unitree_arm_interface.ArmFSMState
arm.loopOn()
arm.labelRun("forward")
arm.startTrack(state.JOINTCTRL)
for i in range(100):
    arm.jointCtrlCmd(np.array([1, 0, 0, 0, 0, 0, -1]), 0.5)
    time.sleep(0.002)
time.sleep(0.05)
tracked = arm.lowstate.getQ()
moved = arm.MoveJ(np.array([0, 0, 0, 0.45, -0.2, 0.2]), 0.0, 1.0)
arm.loopOff()
arm.setFsmLowcmd()
held = arm.lowstate.getQ()
for i in range(50):
    arm.q, arm.qd = held, np.zeros(6)
    arm.tau = arm._ctrlComp.armModel.inverseDynamics(held, np.zeros(6), np.zeros(6), np.zeros(6))
    arm.sendRecv()
    time.sleep(0.002)
drift = np.abs(arm.lowstate.getQ() - held).max()
arm.loopOn()
arm.backToStart()
arm.loopOff()
"""


@pytest.mark.integration
def test_a_script_of_the_vendors_kind_runs_unmodified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    peer = FakeController(WallClock())
    peer.rests = True
    pivot_kinematics().inverse(pivot_kinematics().forward(FORWARD), FORWARD)  # compiles the solver
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    with serving(peer) as (command_port, state_port), vendor.masquerade():
        monkeypatch.setattr(ArmInterface, "udp", vendor.UDPPort("127.0.0.1", command_port, state_port))
        result = runpy.run_path(str(script))
        result["arm"]._close()
    assert result["tracked"][0] == pytest.approx(0.1, abs=0.03)
    assert result["moved"]
    assert result["drift"] < 0.05
    assert peer.q[:6] == pytest.approx(LABELS["startFlat"], abs=0.01)
    assert peer.fsm is Fsm.JOINTCTRL


@pytest.mark.integration
def test_without_a_controller_a_script_ends_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ArmInterface, "udp", vendor.UDPPort("127.0.0.1", 9, 0xFFFF))
    arm = ArmInterface()
    with raises(HalTimeoutError, "no_controller"):
        arm.loopOn()

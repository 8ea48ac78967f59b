"""Rigs of one arm and one camera by name: the twin's camera renders the arm of another device."""

from __future__ import annotations

import numpy as np
import pytest

from hal.backends.mixed_rig import make_mixed_rig
from hal.backends.mock_arm import MockArm
from hal.backends.no_camera import NoCamera
from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig
from hal.base import z1
from hal.base.errors import HalTimeoutError, UnknownBackendError
from hal.base.messages import ArmState
from sim_twin.backends import TwinArm, TwinCamera
from sim_twin.drop_in.rig import free_ports
from sim_twin.model.scene import SceneConfig
from tests.support.errors import raises


def state_at(q: np.ndarray) -> ArmState:
    return ArmState(stamp_s=0.0, q=q, dq=np.zeros(z1.N_JOINTS), tau=np.zeros(z1.N_JOINTS))


@pytest.mark.integration
def test_the_twins_camera_renders_the_measured_joints_of_the_rigs_arm() -> None:
    scene = SceneConfig(object="box", noise=False)
    rig = make_mixed_rig("mock", "sim", scene=scene)
    assert isinstance(rig.arm, MockArm) and isinstance(rig.camera, TwinCamera) and rig.follow_arm is not None
    home = np.append(z1.Q_HOME, -1.0)
    turned = home + np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    measured = [home]
    rig.follow_arm(lambda: state_at(measured[0]))
    rig.camera.connect()
    try:
        first = rig.camera.wait_for_frame(1.0)
        measured[0] = turned
        second = rig.camera.wait_for_frame(1.0)
    finally:
        rig.camera.disconnect()
    np.testing.assert_array_equal(rig.camera.world.read_arm()[0], turned)
    assert first.ground_truth_mask is not None and second.ground_truth_mask is not None
    # The camera turned to the left, by a third of its field of view: the object went to the right
    columns = [np.nonzero(mask)[1].mean() for mask in (first.ground_truth_mask, second.ground_truth_mask)]
    assert columns[1] > columns[0] + 50.0


def test_the_real_arm_keeps_its_search_its_return_and_its_parking_under_any_camera() -> None:
    rig = make_mixed_rig("z1", "sim", z1=Z1ArmConfig(connect_timeout_s=1.0))
    assert isinstance(rig.arm, Z1Arm)
    assert rig.find_arm is not None and rig.give_back == rig.arm.give_back
    assert rig.park is not None and rig.park.disable_motors == rig.arm.go_passive


@pytest.mark.integration
def test_the_twins_arm_has_the_scene_and_no_camera_of_its_own() -> None:
    scene = SceneConfig(arm_latency_s=0.004)
    rig = make_mixed_rig("sim", "none", scene=scene)
    assert isinstance(rig.arm, TwinArm) and rig.arm.world.config is scene
    assert isinstance(rig.camera, NoCamera) and rig.follow_arm is None


def test_the_search_for_a_missing_arm_ends_and_names_its_address() -> None:
    command_port, state_port = free_ports()
    config = Z1ArmConfig(command_port=command_port, state_port=state_port, connect_timeout_s=0.05)
    rig = make_mixed_rig("z1", "none", z1=config)
    assert rig.find_arm is not None
    with raises(HalTimeoutError, "no_controller"):
        rig.find_arm()


def test_an_unknown_device_is_rejected_with_the_known_ones() -> None:
    with raises(UnknownBackendError, "unknown_backend") as caught:
        make_mixed_rig("mock", "d455")
    assert "d405" in str(caught.value) and "none" in str(caught.value)
    with pytest.raises(UnknownBackendError):
        make_mixed_rig("z2", "none")

from dataclasses import asdict

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import ArmSetpoint
from sim_twin.backends import TwinArm
from sim_twin.benchmark.episodes.physics import Physics
from sim_twin.benchmark.episodes.scenarios import Scenario, grid
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.errors import raises

NOISY = Scenario(object="box", distance="mid", lateral="left", pitch_deg=0.0, physics_noise=True)


def test_a_scenario_always_draws_the_same_and_no_two_draw_alike():
    sample = [scenario.physics for scenario in grid(physics_noise=True)]
    assert sample == [scenario.physics for scenario in grid(physics_noise=True)]
    assert len(set(sample)) == 81


def test_what_is_drawn_fills_its_range():
    sample = [Physics.sample(seed) for seed in range(300)]
    for name, low, high in (("friction_factor", 0.7, 1.3), ("mass_factor", 0.7, 1.3), ("arm_latency_s", 0.0, 0.02)):
        values = np.array([getattr(physics, name) for physics in sample])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high


@pytest.mark.integration
def test_the_world_is_as_drawn_and_the_row_says_so():
    scene, row = NOISY.scene(), NOISY.columns()
    usual = World(SceneConfig(object="box", lateral_m=0.15)).model
    model = World(scene).model
    factor = row["mass_factor"]
    assert model.body("object").mass[0] == pytest.approx(0.25 * factor)
    np.testing.assert_allclose(model.geom_friction, usual.geom_friction * row["friction_factor"])
    off = np.linalg.inv(z1.T_FLANGE_CAMERA) @ scene.T_flange_camera()
    assert np.linalg.norm(off[:3, 3]) == pytest.approx(0.003)
    assert np.degrees(np.arccos((np.trace(off[:3, :3]) - 1) / 2)) == pytest.approx(1.0, abs=1e-6)
    assert row["arm_latency_s"] == scene.arm_latency_s > 0
    assert asdict(NOISY.physics).items() <= row.items()


def test_without_noise_nothing_is_off():
    plain = Scenario(object="box", distance="mid", lateral="left", pitch_deg=0.0)
    assert plain.physics == Physics()
    np.testing.assert_array_equal(plain.scene().T_flange_camera(), z1.T_FLANGE_CAMERA)


@pytest.mark.integration
def test_actuation_latency_delays_setpoints_but_not_the_stop():
    world = World(SceneConfig(arm_latency_s=0.01))
    arm = TwinArm(world)
    arm.connect()
    q, before = world.read_arm()[0], world.data.ctrl.copy()
    sent = [ArmSetpoint(q=q + 0.001 * n * np.eye(7)[0], dq=np.zeros(7)) for n in range(1, 8)]
    for setpoint in sent[:5]:
        arm.send(setpoint)
        np.testing.assert_array_equal(world.data.ctrl, before)
    for setpoint, due in zip(sent[5:], sent, strict=False):
        arm.send(setpoint)
        np.testing.assert_allclose(world.data.ctrl, z1.KP * due.q)
    arm.stop()
    np.testing.assert_allclose(world.data.ctrl, z1.KP * world.read_arm()[0])


@pytest.mark.parametrize("field", ["friction_factor", "mass_factor", "arm_latency_s"])
def test_a_deviation_out_of_range_is_rejected(field):
    with raises(InvalidValueError, "scene_range"):
        SceneConfig(**{field: 99})

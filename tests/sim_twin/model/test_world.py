import mujoco
import numpy as np
import pytest

from hal.base import z1
from sim_twin.model.objects import PAPER_OBJECTS
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import GRIPPER_START_RAD, World

_GRIP_NM = 3.0
_LOW = np.array([0.0, 1.65, -0.35, -1.30, 0.0, 1.57, -1.1])
_HIGH = np.array([0.0, 1.50, -0.80, -0.70, 0.0, 1.57, -1.1])  # 0.10 m above, level too
_HALF_WIDTH_M = {"bottle": 0.033, "box": 0.020, "cylinder": 0.030}


def _steps(seconds: float) -> int:
    return round(seconds / z1.CONTROL_PERIOD_S)


def _smooth(share: float) -> tuple[float, float]:
    """Return position and speed of a smooth 0 → 1 at `share` of its time."""
    share = min(share, 1.0)
    return 3 * share**2 - 2 * share**3, 6 * share - 6 * share**2


def _move(world: World, q_start: np.ndarray, q_end: np.ndarray, duration_s: float) -> np.ndarray:
    """Move smoothly; return the largest tracking error of each joint (7,) [rad]."""
    worst = np.zeros(z1.N_JOINTS)
    for step in range(1, _steps(duration_s) + 1):
        position, speed = _smooth(step * z1.CONTROL_PERIOD_S / duration_s)
        q = q_start + position * (q_end - q_start)
        world.set_command(q, speed / duration_s * (q_end - q_start))
        world.step()
        worst = np.maximum(worst, np.abs(world.read_arm()[0] - q))
    world.set_command(q_end, np.zeros(z1.N_JOINTS))
    return worst


def test_the_world_starts_at_home_with_open_jaws_and_everything_at_rest(world: World) -> None:
    q, dq, tau = world.read_arm()
    np.testing.assert_allclose(q, [*z1.Q_HOME, GRIPPER_START_RAD], atol=1e-4)
    np.testing.assert_allclose(dq, 0.0, atol=1e-4)
    assert abs(tau[1]) > 1.0  # the motors carry the arm
    assert world.time_s == 0.0
    assert world.lifted_m() == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(world.T_base_object()[:3, 3], [0.48, 0.0, 0.1], atol=1e-4)


@pytest.mark.integration
@pytest.mark.parametrize("joint", range(z1.N_JOINTS))
def test_a_move_of_one_radian_a_second_is_tracked_within_20_mrad_and_settles_within_2(joint: int) -> None:
    world = World(SceneConfig(object="cylinder", distance_m=0.65, lateral_m=0.25))
    start = np.append(z1.Q_HOME, GRIPPER_START_RAD)
    goal = start.copy()
    goal[joint] += 0.8 if joint in (0, 4, 6) else -0.8
    worst = _move(world, start, goal, duration_s=1.2)  # fastest in the middle: 1.5 · 0.8 / 1.2 = 1 rad/s
    assert worst.max() < 0.020
    for _ in range(_steps(0.5)):
        world.step()
    error = np.abs(world.read_arm()[0] - goal)
    assert error[: z1.N_ARM].max() < 2e-3
    assert error[z1.N_ARM] < 4e-3  # the gripper's servo is soft: 0.3 Nm of dry friction on 128 Nm/rad


def test_no_motor_gives_more_than_its_limit() -> None:
    world = World(SceneConfig(object="cylinder", distance_m=0.65, lateral_m=0.25))
    q, _, _ = world.read_arm()
    world.set_command(q + np.array([1.0, 0.5, -1.0, 0.5, 0.5, 0.5, 0.5]), np.zeros(z1.N_JOINTS))
    for _ in range(20):
        world.step()
        tau = world.read_arm()[2]
        assert (np.abs(tau) <= z1.TAU_MAX + 1e-9).all()


def _put_between_the_jaws(world: World, along_m: float) -> np.ndarray:
    """Level the gripper, put the object upright at the stationary jaw's pad, close to 3 Nm; return the joints (7,)."""
    q = _LOW.copy()
    data, model = world.data, world.model
    data.qpos[: z1.N_JOINTS], data.qvel[:] = q, 0.0
    mujoco.mj_forward(model, data)
    R_base_flange = data.body("link06").xmat.reshape(3, 3)
    half = _HALF_WIDTH_M[world.config.object]
    data.qpos[7:10] = data.body("gripperMover").xpos + R_base_flange @ [along_m, 0.0, -0.009 + half]
    data.qpos[10:14] = [1.0, 0.0, 0.0, 0.0]
    gravity = model.opt.gravity.copy()
    model.opt.gravity[:] = 0.0
    while q[6] - world.read_arm()[0][6] < _GRIP_NM / z1.KP[6]:
        q[6] += 0.001
        assert q[6] < 0.0, "the jaws closed on nothing"
        world.set_command(q, np.zeros(z1.N_JOINTS))
        world.step()
    model.opt.gravity[:] = gravity
    for _ in range(_steps(0.2)):
        world.step()
    return q


def _object_in_gripper(world: World) -> np.ndarray:
    data, T_base_gripper = world.snapshot(), np.eye(4)
    body = data.body("gripperStator")
    T_base_gripper[:3, :3], T_base_gripper[:3, 3] = body.xmat.reshape(3, 3), body.xpos
    return np.linalg.inv(T_base_gripper) @ world.T_base_object()


@pytest.mark.integration
@pytest.mark.parametrize("name", PAPER_OBJECTS)
def test_a_held_object_is_lifted_and_neither_slips_nor_sinks_in(name: str) -> None:
    world = World(SceneConfig(object=name))
    command = _put_between_the_jaws(world, along_m=0.080)
    before, height = _object_in_gripper(world), world.T_base_object()[2, 3]
    _move(world, command, command + _HIGH - _LOW, duration_s=1.0)
    after_lift, deepest = _object_in_gripper(world), 0.0
    for _ in range(_steps(3.0)):
        world.step()
        deepest = min(deepest, world.data.contact.dist.min())
    after = _object_in_gripper(world)
    assert world.T_base_object()[2, 3] - height > 0.05
    assert deepest > -1e-3
    for earlier in (before, after_lift):
        make_homogeneous_lathe = np.arccos(np.clip((np.trace(earlier[:3, :3].T @ after[:3, :3]) - 1) / 2, -1, 1))
        assert np.linalg.norm(after[:3, 3] - earlier[:3, 3]) < 1e-3
        assert np.rad2deg(make_homogeneous_lathe) < 1.0


@pytest.mark.integration
@pytest.mark.parametrize("pitch_deg", [-45.0, 45.0])
def test_a_leaning_object_stays_put_until_touched(pitch_deg: float) -> None:
    world = World(SceneConfig(object="bottle", pitch_deg=pitch_deg))
    world.advance_to(1.0)
    assert world.fixture_holds
    np.testing.assert_allclose(world.T_base_object(), world.config.T_base_object(), atol=2e-3)


def _run_into_the_object(world: World) -> None:
    """Turn joint 1 with the gripper low, so that it sweeps through the object's place."""
    start = np.array([-0.6, 2.0, -0.5, -1.1, 0.0, 1.57, -0.2])
    world.data.qpos[: z1.N_JOINTS] = start
    world.set_command(start, np.zeros(z1.N_JOINTS))
    goal = start.copy()
    goal[0] = 0.6
    _move(world, start, goal, duration_s=2.0)


@pytest.mark.integration
def test_a_push_breaks_the_fixture_for_good() -> None:
    world = World(SceneConfig(object="bottle", pitch_deg=20.0, distance_m=0.45))
    _run_into_the_object(world)
    assert not world.fixture_holds
    world.advance_to(world.time_s + 1.0)
    assert not world.fixture_holds
    assert np.linalg.norm(world.T_base_object()[:3, 3] - world.config.T_base_object()[:3, 3]) > 0.015


@pytest.mark.integration
def test_closing_the_jaws_on_it_takes_the_object_out_of_the_fixture() -> None:
    world = World(SceneConfig(object="cylinder", pitch_deg=5.0))
    data, model = world.data, world.model
    # Bring the gripper to the object instead of the object to the gripper: the fixture stays where it is.
    fixture = model.equality("fixture").id
    assert data.eq_active[fixture]
    data.eq_active[fixture] = 0
    command = _put_between_the_jaws(world, along_m=0.080)
    assert not world.fixture_holds
    _move(world, command, command + _HIGH - _LOW, duration_s=1.0)
    assert not data.eq_active[fixture]
    assert world.lifted_m() > 0.05


@pytest.mark.integration
def test_a_snapshot_does_not_move_with_the_world() -> None:
    world = World(SceneConfig(object="cylinder"))
    before = world.snapshot()
    position = before.body("link06").xpos.copy()
    q, _, _ = world.read_arm()
    _move(world, q, q + 0.6 * np.eye(z1.N_JOINTS)[0], duration_s=0.8)
    np.testing.assert_array_equal(before.body("link06").xpos, position)
    assert np.linalg.norm(world.snapshot(before).body("link06").xpos - position) > 0.05

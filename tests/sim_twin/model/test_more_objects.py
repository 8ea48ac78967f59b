import numpy as np
import pytest

from sim_twin.camera.d405 import INTRINSICS
from sim_twin.camera.render import make_renderer
from sim_twin.model.objects import EXTENDED, OBJECTS
from sim_twin.model.parts import make_homogeneous_lathe, make_wall
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World

pytestmark = pytest.mark.integration

_RGBA = (0.5, 0.5, 0.5, 1.0)


@pytest.fixture(scope="module", params=EXTENDED)
def world(request: pytest.FixtureRequest) -> World:
    return World(SceneConfig(object=request.param))


def test_it_stays_upright(world: World) -> None:
    start = world.config.T_base_object()
    world.advance_to(1.0)
    pose = world.T_base_object()
    assert np.degrees(np.arccos(min(pose[2, 2], 1.0))) < 0.5
    np.testing.assert_allclose(pose[:3, 3], start[:3, 3], atol=1e-3)
    assert np.abs(world.data.qvel[-6:]).max() < 1e-2


def test_it_is_drawn_at_its_pose(world: World) -> None:
    renderer = make_renderer(world.model, INTRINSICS, "rays")
    data = world.snapshot()
    view = renderer.render(data)
    renderer.close()
    assert view.mask.sum() > 1000
    rows, columns = np.nonzero(view.mask)
    z = view.z_m[rows, columns]
    across = np.column_stack([(columns - INTRINSICS.cx) / INTRINSICS.fx, (rows - INTRINSICS.cy) / INTRINSICS.fy])
    camera = data.cam("wrist")
    R_base_camera = camera.xmat.reshape(3, 3) * [1.0, -1.0, -1.0]
    points = np.column_stack([across * z[:, None], z]) @ R_base_camera.T + camera.xpos
    corners = OBJECTS[world.config.object].corners() + world.T_base_object()[:3, 3]
    assert (points > corners.min(axis=0) - 2e-3).all()
    assert (points < corners.max(axis=0) + 2e-3).all()
    np.testing.assert_allclose(points[:, 2].max(), corners[:, 2].max(), atol=5e-3)


def test_it_is_as_high_as_it_says_and_its_origin_at_mid_height(world: World) -> None:
    grasp_object = OBJECTS[world.config.object]
    heights = grasp_object.corners()[:, 2]
    np.testing.assert_allclose(
        [heights.min(), heights.max()], [-grasp_object.height_m / 2, grasp_object.height_m / 2], atol=1e-6
    )
    assert 0.05 <= grasp_object.mass_kg <= 0.35
    assert world.model.body("object").mass[0] == pytest.approx(grasp_object.mass_kg)


def test_a_turned_part_weighs_by_its_volume() -> None:
    cylinder, cone = make_homogeneous_lathe(((0.0, 0.03), (0.06, 0.03), (0.12, 0.0)), 0.4, _RGBA)
    assert (cylinder.mass_kg, cone.mass_kg) == (pytest.approx(0.3), pytest.approx(0.1))


def test_a_wall_is_hollow_and_has_no_gaps() -> None:
    staves = make_wall((0.02, 0.03), (0.02, 0.03), (0.0, 0.1), 0.16, _RGBA)
    assert sum(stave.mass_kg for stave in staves) == pytest.approx(0.16)
    bearings = [np.arctan2(s.corners()[:, 1].mean(), s.corners()[:, 0].mean()) for s in staves]
    np.testing.assert_allclose(np.diff(np.unwrap(bearings)), 2 * np.pi / len(staves))
    for stave, following in zip(staves, np.roll(np.arange(len(staves)), -1), strict=True):
        shared = {tuple(c) for c in stave.corners().round(9)} & {tuple(c) for c in staves[following].corners().round(9)}
        assert len(shared) == 4
    assert np.hypot(*np.vstack([s.corners() for s in staves])[:, :2].T).min() == pytest.approx(0.02)

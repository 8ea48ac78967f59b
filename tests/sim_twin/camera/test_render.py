from itertools import product

import mujoco
import numpy as np
import pytest

from sim_twin.camera.d405 import INTRINSICS, MIN_Z_M, View, measure_depth
from sim_twin.camera.render import make_renderer
from sim_twin.model.objects import PAPER_OBJECTS
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.gl_here import needs_egl


def _draw(config: SceneConfig, kind: str) -> View:
    world = World(config)
    renderer = make_renderer(world.model, INTRINSICS, kind)
    view = renderer.render(world.snapshot())
    renderer.close()
    return view


@pytest.mark.integration
@needs_egl
@pytest.mark.parametrize("name", PAPER_OBJECTS)
def test_rays_and_egl_see_the_same_depth_and_the_same_object(name: str) -> None:
    config = SceneConfig(object=name, pitch_deg=20.0, lateral_m=0.05)
    egl, rays = _draw(config, "egl"), _draw(config, "rays")
    assert (egl.mask & rays.mask).sum() / (egl.mask | rays.mask).sum() > 0.99
    valid = (egl.z_m > 0) & (rays.z_m > 0)
    assert valid.sum() > 0.995 * max((egl.z_m > 0).sum(), (rays.z_m > 0).sum())
    error = np.abs(egl.z_m - rays.z_m)[valid]
    assert np.median(error) < 2e-5
    assert np.percentile(error, 99) < 2e-3  # OpenGL draws cylinders with flat facets, and edges half a pixel apart


@pytest.mark.integration
@needs_egl
def test_the_table_is_where_the_pinhole_and_the_mount_say() -> None:
    world = World(SceneConfig(object="cylinder"))
    data = world.snapshot()
    renderer = make_renderer(world.model, INTRINSICS, "egl")
    view = renderer.render(data)
    renderer.close()
    v, u = np.mgrid[150:260:10, 30:250:10]
    z = view.z_m[v, u]
    points = np.stack([(u - INTRINSICS.cx) / INTRINSICS.fx * z, (v - INTRINSICS.cy) / INTRINSICS.fy * z, z], axis=-1)
    R_base_camera = data.cam("wrist").xmat.reshape(3, 3) * [1, -1, -1]
    height = points.reshape(-1, 3) @ R_base_camera[2] + data.cam("wrist").xpos[2]
    np.testing.assert_allclose(height, 0.0, atol=2e-4)


@pytest.mark.integration
@needs_egl
@pytest.mark.parametrize("name", PAPER_OBJECTS)
def test_from_home_every_object_is_seen_past_the_open_jaws_and_beyond_min_z(name: str) -> None:
    world = World(SceneConfig(object=name))
    data = world.snapshot()
    renderer = make_renderer(world.model, INTRINSICS, "egl")
    for distance_m, lateral_m, pitch_deg in product((0.40, 0.56), (-0.15, 0.15), (-45.0, 0.0, 45.0)):
        config = SceneConfig(object=name, distance_m=distance_m, lateral_m=lateral_m, pitch_deg=pitch_deg)
        half = np.deg2rad(pitch_deg) / 2
        data.qpos[7:] = [*config.T_base_object()[:3, 3], np.cos(half), 0.0, np.sin(half), 0.0]
        mujoco.mj_kinematics(world.model, data)
        view = renderer.render(data)
        assert view.z_m[view.mask].min() > 2 * MIN_Z_M, config
        depth = measure_depth(view.z_m, seed=0, sequence=1)
        assert (depth[view.mask] > 0).sum() > 2000, config
        rows, columns = np.nonzero(view.mask)
        assert 0 < rows.min() <= rows.max() < INTRINSICS.height - 1, config
        assert 0 < columns.min() <= columns.max() < INTRINSICS.width - 1, config
    renderer.close()


@pytest.mark.integration
def test_the_wrist_camera_does_not_see_its_own_housing() -> None:
    z_m = _draw(SceneConfig(object="cylinder"), "rays").z_m
    assert z_m[z_m > 0].min() > 0.04  # the gripper's back; the housing begins at 0 and the bracket behind it
    assert z_m[:200][z_m[:200] > 0].min() > 0.2

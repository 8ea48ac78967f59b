import io

import numpy as np
import pytest
from PIL import Image

from sim_twin.camera.external_view import draw_picture, render_external
from sim_twin.model.world import World
from tests.support.gl_here import needs_egl

SIZE = (320, 180)


@pytest.mark.integration
@needs_egl
def test_the_outside_view_by_gl_and_by_rays_shows_the_same_scene(world: World) -> None:
    egl, rays = (render_external(world.model, world.snapshot(), *SIZE, kind).astype(float) for kind in ("egl", "rays"))
    assert egl.shape == rays.shape == (180, 320, 3)
    # Nothing else is as blue as the bottle.
    blue = [picture[..., 2] - picture[..., 0] > 45 for picture in (egl, rays)]
    assert blue[0].sum() > 300
    assert (blue[0] & blue[1]).sum() / (blue[0] | blue[1]).sum() > 0.85


@pytest.mark.integration
@pytest.mark.parametrize("kind", [pytest.param("egl", marks=needs_egl), "rays"])
def test_a_picture_is_drawn_from_the_positions_alone(world: World, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("Z1_TWIN_RENDER", kind)
    qpos = world.snapshot().qpos.copy()
    here = np.asarray(Image.open(io.BytesIO(draw_picture(world.config, qpos, *SIZE))))
    np.testing.assert_allclose(here, render_external(world.model, world.snapshot(), *SIZE), atol=1)
    qpos[9] += 0.1
    lifted = np.asarray(Image.open(io.BytesIO(draw_picture(world.config, qpos, *SIZE))))
    assert (np.abs(lifted.astype(int) - here).max(axis=2) > 30).mean() > 0.005

"""The twin in Rerun: objects are drawn at their poses, and move with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from hal.base import z1
from scripts.support.twin_view import TwinView, draw_geoms
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from z1_runtime.visualization import blueprint


def test_recording_holds_robot_and_objects_and_their_motion(tmp_path: Path) -> None:
    world, file = World(SceneConfig()), tmp_path / "twin.rrd"
    view = TwinView(world, out=file)
    view.update()
    world.set_command(np.append(z1.Q_HOME + 0.2, -1.0), np.zeros(7))
    world.advance_to(0.5)
    view.update()
    view.close()
    paths: set[str] = set()
    rows = 0
    for chunk in RrdReader(file).stream():
        paths.add(str(chunk.entity_path).lstrip("/"))
        if str(chunk.entity_path).lstrip("/") == blueprint.POSITION and not chunk.is_static:
            rows += chunk.num_rows
    assert rows == 2
    assert "world/twin/object" in paths
    assert any(path.startswith(f"{blueprint.ARM}/") for path in paths)
    assert sum(path.startswith("world/twin/world/geom") for path in paths) >= 2  # floor and table


@pytest.mark.integration
@pytest.mark.parametrize("name", ["bottle", "box", "cylinder"])
def test_every_geom_of_the_scene_has_a_shape(name: str) -> None:
    model = World(SceneConfig(object=name)).model
    drawn = list(draw_geoms(model))
    shapes = [entity for _, entity in drawn if not isinstance(entity, rr.Transform3D)]
    assert 2 * len(shapes) == len(drawn)
    assert len(shapes) >= 3

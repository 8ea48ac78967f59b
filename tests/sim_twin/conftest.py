"""Worlds that several tests look at without changing them."""

import pytest

from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World


@pytest.fixture(scope="session")
def world() -> World:
    return World(SceneConfig())

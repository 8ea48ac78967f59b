import numpy as np
import pytest

from sim_twin.model.objects import EXTENDED_OBJECTS, OBJECT_NAMES, OBJECTS, PAPER_OBJECTS
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World


def test_there_are_the_papers_three_objects_and_at_least_twelve_more() -> None:
    assert PAPER_OBJECTS == ("bottle", "box", "cylinder")
    assert len(EXTENDED_OBJECTS) >= 12
    assert OBJECT_NAMES == PAPER_OBJECTS + EXTENDED_OBJECTS


@pytest.mark.parametrize(
    ("name", "size_m", "mass_kg"),
    [("bottle", (0.066, 0.066, 0.2), 0.30), ("box", (0.07, 0.04, 0.15), 0.25), ("cylinder", (0.06, 0.06, 0.15), 0.20)],
)
def test_objects_have_the_size_and_mass_they_are_sold_with(name: str, size_m: tuple, mass_kg: float) -> None:
    grasp_object = OBJECTS[name]
    np.testing.assert_allclose(np.ptp(grasp_object.corners(), axis=0), size_m, atol=2e-4)
    assert grasp_object.mass_kg == pytest.approx(mass_kg)
    assert grasp_object.height_m == pytest.approx(size_m[2])


@pytest.mark.integration
def test_the_compiled_inertia_is_that_of_a_solid_cylinder() -> None:
    model = World(SceneConfig(object="cylinder")).model
    radius, height, mass = 0.030, 0.150, 0.20
    across, along = mass * (3 * radius**2 + height**2) / 12, mass * radius**2 / 2
    np.testing.assert_allclose(sorted(model.body("object").inertia), sorted([across, across, along]), rtol=1e-6)


@pytest.mark.integration
def test_the_water_pulls_the_bottles_centre_of_mass_below_its_middle() -> None:
    model = World(SceneConfig(object="bottle")).model
    assert model.body("object").mass[0] == pytest.approx(0.30)
    assert -0.055 < model.body("object").ipos[2] < -0.045  # water to 80 of 200 mm

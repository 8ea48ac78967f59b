"""The dynamics test of grasps, and the convex pieces for the physics engine."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from models.diffusion.training.convex import split_turned_solid
from models.diffusion.training.dynamics_test import DynamicsTestConfig, simulate_grasps
from models.diffusion.training.grippers import GRIPPERS, ParallelGripperSpec
from models.diffusion.training.labels import check_grasps, find_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.solids import BOX, Solid, make_part, make_solid

GRIPPER = GRIPPERS["agnostic"]
assert isinstance(GRIPPER, ParallelGripperSpec)
BRICK = make_solid("box", [make_part(BOX, (0.02, 0.03, 0.05))])


def grasp(closing: tuple, approach: tuple, at: tuple) -> np.ndarray:
    y, z = np.array(closing, dtype=float), np.array(approach, dtype=float)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = at
    return T[None]


def simulate(solid: Solid, T: np.ndarray, gripper: ParallelGripperSpec = GRIPPER, **settings) -> np.ndarray:
    return simulate_grasps(solid, T, check_grasps(solid, T, gripper), gripper, DynamicsTestConfig(**settings))


def test_a_grasp_square_across_a_brick_holds_it():
    assert simulate(BRICK, grasp((1, 0, 0), (0, 0, -1), (0.0, 0.0, 0.035))).all()


def test_an_object_heavier_than_the_friction_force_is_lost():
    T = grasp((1, 0, 0), (0, 0, -1), (0.0, 0.0, 0.035))
    assert simulate(BRICK, T, mass_kg=(1.0, 1.0)).all()  # 40 N of friction against 20 N
    assert not simulate(BRICK, T, mass_kg=(4.0, 4.0)).any()


def test_the_mass_of_a_repeated_part_counts_once():
    twice = Solid(family="box", parts=np.repeat(BRICK.parts, 3, axis=0), profiles=np.repeat(BRICK.profiles, 3, axis=0))
    T = grasp((1, 0, 0), (0, 0, -1), (0.0, 0.0, 0.035))
    mass = 8 * 0.02 * 0.03 * 0.05
    for density in (0.7 / mass, 3.0 / mass):  # three times the former is too heavy
        once, again = (simulate(s, T, density_kg_m3=density, mass_kg=(0.01, 10.0)).all() for s in (BRICK, twice))
        assert once == again == (density < 1.0 / mass)


def test_a_wedge_is_squeezed_out_where_friction_is_low():
    outline = [(0.0, 0.0), (0.045, 0.0), (0.010, 0.08), (0.0, 0.08)]
    wedge = Solid(family="cone", **dict(zip(("parts", "profiles"), _turn(outline), strict=True)))
    T = grasp((1, 0, 0), (0, 0, -1), (0.0, 0.0, 0.055))
    assert not simulate(wedge, T, ParallelGripperSpec(name="slippery", max_width_m=0.136, friction=0.1)).any()
    assert simulate(wedge, T, ParallelGripperSpec(name="rubber", max_width_m=0.136, friction=1.0)).all()


def _turn(outline: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    solid = make_solid("cone", [make_part(3, profile=outline)])
    return solid.parts, solid.profiles


def test_grasps_on_nothing_or_in_collision_are_lost_without_simulation():
    T = np.concatenate([grasp((1, 0, 0), (0, 0, -1), (0.0, 0.0, 0.3)), grasp((1, 0, 0), (0, 0, -1), (0.065, 0.0, 0.0))])
    assert not simulate(BRICK, T).any()


@pytest.mark.integration
@pytest.mark.parametrize("family", ["bottle", "cup", "union", "mug"])
def test_nearly_all_labels_hold_in_the_dynamics_test(family):
    rng = np.random.default_rng(3)
    solid = make_shape(family, rng)
    T, _ = find_grasps(solid, GRIPPER, rng, 300)
    T = T[rng.permutation(len(T))[:10]]
    assert simulate(solid, T).mean() >= 0.9


def test_a_turned_outline_is_filled_by_its_pieces():
    outline = np.array([(0.0, -0.05), (0.03, -0.05), (0.02, 0.01), (0.035, 0.05), (0.0, 0.05)])
    volume = sum(ConvexHull(piece).volume for piece in split_turned_solid(outline))
    frusta = [(0.03, 0.02, 0.06), (0.02, 0.035, 0.04)]
    expected = sum(np.pi * h / 3.0 * (a * a + a * b + b * b) for a, b, h in frusta)
    assert volume == pytest.approx(expected, rel=0.03)  # a polygon of 20 corners has 1.6 % less than its circle


def test_the_pieces_of_a_cup_leave_its_inside_free():
    outline = np.array([(0.0, -0.05), (0.03, -0.05), (0.04, 0.05), (0.036, 0.05), (0.026, -0.046), (0.0, -0.046)])
    pieces = split_turned_solid(outline)
    inside = np.array([0.0, 0.0, 0.0])
    hulls = [ConvexHull(piece) for piece in pieces]
    assert not any((h.equations[:, :3] @ inside + h.equations[:, 3] <= 1e-9).all() for h in hulls)
    wall = np.array([0.033, 0.0, 0.0])
    wall_turned = 0.9985 * np.array([wall[0] * np.cos(0.1), wall[0] * np.sin(0.1), 0.0])
    assert any((h.equations[:, :3] @ wall_turned + h.equations[:, 3] <= 1e-4).all() for h in hulls)


def test_rounded_edges_extend_to_the_solids_surface():
    outline = np.array([(0.0, -0.04), (0.02, -0.04), (0.02, 0.04), (0.0, 0.04)])
    corners = np.concatenate(split_turned_solid(outline, 0.003))
    assert np.hypot(corners[:, 0], corners[:, 1]).max() == pytest.approx(0.023)
    assert np.abs(corners[:, 2]).max() == pytest.approx(0.043)

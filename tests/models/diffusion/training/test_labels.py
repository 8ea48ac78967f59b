"""Solids, views and ground truth: the training data of the generator."""

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse, transform_points
from models.diffusion.training.grippers import GRIPPERS, ParallelGripperSpec
from models.diffusion.training.labels import check_grasps, find_grasps
from models.diffusion.training.shapes import FAMILY_WEIGHTS, HELD_OUT_FAMILIES, KNOWN_FAMILIES, make_shape
from models.diffusion.training.solids import BOX, CAPSULE, LATHE, TORUS, make_part, make_solid
from models.diffusion.training.views import ViewConfig, render_view
from tests.support.errors import raises

GRIPPER = GRIPPERS["agnostic"]
BRICK = make_solid("box", [make_part(BOX, (0.02, 0.03, 0.08))])


def view_brick(config: ViewConfig, seed: int) -> tuple[np.ndarray, np.ndarray]:
    view = render_view(BRICK, config, np.random.default_rng(seed))
    assert view is not None
    return view


def grasp(closing: tuple, approach: tuple, at: tuple) -> np.ndarray:
    y, z = np.array(closing, dtype=float), np.array(approach, dtype=float)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = at
    return T[None]


def test_the_distance_of_a_box_is_that_of_its_nearest_face_edge_or_corner():
    points = np.array([[0.03, 0.0, 0.0], [0.05, 0.07, 0.0], [0.0, 0.0, 0.0]])
    assert BRICK.distance(points) == pytest.approx([0.01, 0.05, -0.02], abs=1e-9)


def test_a_turned_rectangle_is_a_cylinder():
    outline = [(0.0, -0.05), (0.03, -0.05), (0.03, 0.05), (0.0, 0.05)]
    solid = make_solid("cylinder", [make_part(LATHE, profile=outline)])
    points = np.array([[0.0, 0.05, 0.0], [0.0, 0.0, 0.06], [0.06, 0.0, 0.09], [0.0, 0.0, 0.0], [0.01, 0.0, 0.0]])
    assert solid.distance(points) == pytest.approx([0.02, 0.01, 0.05, -0.03, -0.02], abs=1e-6)


def test_a_cup_is_open_and_a_ring_has_a_hole():
    cup = make_shape("cup", np.random.default_rng(0))
    assert cup.distance(np.zeros((1, 3)))[0] > 0.01
    ring = make_solid("ring", [make_part(TORUS, (0.04, 0.005))])
    assert ring.distance(np.array([[0.0, 0.0, 0.0], [0.04, 0.0, 0.0]])) == pytest.approx([0.035, -0.005], abs=1e-9)


def test_rays_stop_at_the_surface_and_normals_point_out_of_it():
    reach = BRICK.cast(np.array([[0.1, 0.01, 0.02], [0.1, 0.2, 0.0]]), np.array([[-1.0, 0, 0], [-1.0, 0, 0]]), 1.0)
    assert reach[0] == pytest.approx(0.08, abs=5e-4)
    assert np.isinf(reach[1])
    assert BRICK.normals(np.array([[0.02, 0.01, 0.02]]))[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_a_grasp_square_across_a_box_holds():
    check = check_grasps(BRICK, grasp((1, 0, 0), (0, 1, 0), (0.0, 0.0, 0.0)), GRIPPER)
    assert check.valid.all()
    assert check.widths_m == pytest.approx([0.04], abs=1e-3)
    assert check.offsets_m == pytest.approx([0.0], abs=1e-3)


def test_an_object_off_the_middle_is_held_and_its_offset_reported():
    check = check_grasps(BRICK, grasp((1, 0, 0), (0, 1, 0), (0.02, 0.0, 0.0)), GRIPPER)
    assert check.valid.all()
    assert check.offsets_m == pytest.approx([-0.02], abs=1e-3)


def test_a_grasp_outside_the_friction_cone_is_invalid():
    c, s = np.cos(0.6), np.sin(0.6)
    slanted = check_grasps(BRICK, grasp((c, 0, s), (0, 1, 0), (0.0, 0.0, 0.0)), GRIPPER)
    assert slanted.free.all()
    assert not slanted.antipodal.any()


@pytest.mark.parametrize("at", [(0.07, 0.0, 0.0), (0.0, 0.06, 0.0)])
def test_a_gripper_in_collision_is_not_free(at):
    assert not check_grasps(BRICK, grasp((1, 0, 0), (0, 1, 0), at), GRIPPER).free.any()


def test_an_object_wider_than_the_opening_is_not_held():
    wide = make_solid("box", [make_part(BOX, (0.09, 0.03, 0.03))])
    assert not check_grasps(wide, grasp((1, 0, 0), (0, 1, 0), (0.0, 0.0, 0.0)), GRIPPER).valid.any()


@pytest.mark.parametrize("family", ["bottle", "cup", "l_shape", "hammer"])
def test_ground_truth_holds_comes_from_all_sides_and_states_its_width(family):
    solid = make_shape(family, np.random.default_rng(4))
    T, widths = find_grasps(solid, GRIPPER, np.random.default_rng(0))
    assert len(T) > 50
    check = check_grasps(solid, T, GRIPPER)
    assert check.valid.all()
    assert widths == pytest.approx(check.widths_m)
    assert np.linalg.det(T[:, :3, :3]) == pytest.approx(1.0)
    assert (T[:, :3, 2] > 0.5).any(axis=0).all() and (T[:, :3, 2] < -0.5).any(axis=0).sum() >= 2


def test_ground_truth_reaches_past_its_contacts_within_the_grippers_limits():
    ball = make_solid("sphere", [make_part(CAPSULE, (0.03, 0.0))])
    T, _ = find_grasps(ball, GRIPPER, np.random.default_rng(0))
    past = np.einsum("ni,ni->n", T[:, :3, 3], T[:, :3, 2])  # the contacts' middle is the ball's
    low, high = np.percentile(past, [5, 95])
    assert GRIPPER.min_depth_m - 0.003 < low < high < GRIPPER.max_depth_m + 0.003


def test_a_gripper_with_impossible_sizes_is_rejected():
    with raises(InvalidValueError, "gripper_width"):
        ParallelGripperSpec(name="odd", max_width_m=0.001)


@pytest.mark.integration
def test_every_family_can_be_made_and_grasped_and_none_is_in_both_sets():
    assert not set(KNOWN_FAMILIES) & set(HELD_OUT_FAMILIES)
    assert set(FAMILY_WEIGHTS) == set(KNOWN_FAMILIES)
    for family in (*KNOWN_FAMILIES, *HELD_OUT_FAMILIES):
        solid = make_shape(family, np.random.default_rng(1))
        assert 0.015 < solid.enclosing_radius() < 0.2
        assert len(find_grasps(solid, GRIPPER, np.random.default_rng(1), 600)[0]) > 5
    with raises(InvalidValueError, "unknown_family"):
        make_shape("teapot", np.random.default_rng(0))


def test_a_view_shows_the_near_side_within_the_camera_noise():
    view = ViewConfig(
        distance_m=(0.3, 0.3), noise_per_m=(0.005, 0.005), flying_point_ratio=0.0, occluded_view_ratio=0.0
    )
    points, T_camera_object = view_brick(view, 3)
    T_object_camera = inverse(T_camera_object)
    local = transform_points(T_object_camera, points)
    assert np.quantile(np.abs(BRICK.distance(local)), 0.9) < 3 * 0.005 * 0.3**2
    towards = T_object_camera[:3, 3] - local
    near = np.abs(BRICK.distance(local)) < 2e-4
    assert (np.sum(BRICK.normals(local[near]) * towards[near], axis=1) > 0.0).mean() > 0.95


@pytest.mark.parametrize("elevation", [-20.0, 30.0])
def test_elevation_is_the_cameras_height_over_the_object(elevation):
    view = ViewConfig(
        frontal_ratio=1.0, frontal_elevation_deg=(elevation, elevation), upright_ratio=1.0, occluded_view_ratio=0.0
    )
    eyes = []
    for seed in range(12):
        _, T_camera_object = view_brick(view, seed)
        eye = inverse(T_camera_object)[:3, 3]
        eyes.append(np.degrees(np.arcsin(eye[2] / np.linalg.norm(eye))))
    assert np.mean(eyes) == pytest.approx(elevation, abs=6.0)


def test_depth_noise_grows_with_the_square_of_the_distance():
    def spread(distance: float) -> float:
        config = ViewConfig(
            distance_m=(distance, distance), noise_per_m=(0.01, 0.01), flying_point_ratio=0.0, occluded_view_ratio=0.0
        )
        points, T_camera_object = view_brick(config, 5)
        return float(np.median(np.abs(BRICK.distance(transform_points(inverse(T_camera_object), points)))))

    assert spread(0.5) / spread(0.25) == pytest.approx(4.0, rel=0.35)


def test_occlusion_removes_the_requested_ratio():
    config = ViewConfig(occluded_view_ratio=1.0, occluded_point_ratio=(0.35, 0.35))
    full = view_brick(ViewConfig(occluded_view_ratio=0.0), 2)[0]
    part = view_brick(config, 2)[0]
    assert len(part) / len(full) == pytest.approx(0.65, abs=0.02)

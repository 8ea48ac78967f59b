"""The Z1's beak as a hand to train for: it is where the runtime lays it, and closes from one side."""

import numpy as np
import pytest

from hal.base.z1_gripper import MOVING_FACE, STATIONARY_FACE
from models.diffusion.training import z1_gripper
from models.diffusion.training.labels import GRIPPERS, check_grasps, find_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.solids import BOX, make_part, make_solid
from z1_runtime.geometry.gripper_geometry import BeakConfig
from z1_runtime.geometry.gripper_mesh import gripper_shape
from z1_runtime.grasping.beak_gripper import BeakGripper

HAND = GRIPPERS["z1"]
assert isinstance(HAND, z1_gripper.Z1GripperSpec)
BAR = make_solid("box", [make_part(BOX, (0.012, 0.015, 0.10))])


def around_the_bar(at_y: float = 0.0, turned: float = 0.0) -> np.ndarray:
    """Return a grasp that closes along y and comes along −x, its contacts 12 mm before its origin."""
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)
    c, s = np.cos(turned), np.sin(turned)
    T[:3, :3] = T[:3, :3] @ np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    T[:3, 3] = (-0.012, at_y, 0.0)
    return T[None]


def test_the_beak_lies_as_the_runtime_lays_it():
    runtime = BeakGripper()
    assert BeakConfig().contact_depth_m == z1_gripper.CONTACT_DEPTH_M
    for width in np.arange(0.004, 0.084, 0.004):
        wanted, _ = runtime.fit(np.eye(4), float(width))
        T_pivot, opening = z1_gripper._place(np.eye(4), np.array(z1_gripper.GRIPPER_FIT), width)
        assert T_pivot[:3, 3] == pytest.approx(wanted.T_base_pivot[:3, 3], abs=2e-3)
        assert T_pivot[:3, :3] == pytest.approx(wanted.T_base_pivot[:3, :3], abs=0.02)
        assert -opening == pytest.approx(wanted.jaw_open, abs=0.01)
        assert np.linalg.det(T_pivot[:3, :3]) == pytest.approx(1.0)


def test_its_faces_are_those_of_the_runtime():
    assert np.array(z1_gripper.FIXED_FACE) == pytest.approx(STATIONARY_FACE[: len(z1_gripper.FIXED_FACE)])
    assert np.array(z1_gripper.TURNING_FACE) == pytest.approx(MOVING_FACE)


def test_its_outer_sides_are_those_of_the_meshes():
    shape = gripper_shape()
    for points, outline, lowest in (
        (shape.fixed, z1_gripper.STATIONARY_BACK, True),
        (shape.mover, z1_gripper.MOVING_BACK, False),
    ):
        for x, z in outline[:-1]:
            near = points[(np.abs(points[:, 0] - x) < 0.006) & (np.abs(points[:, 1]) < 0.042)]
            assert (near[:, 2].min() if lowest else near[:, 2].max()) == pytest.approx(z, abs=0.004)
            half = np.interp(x, *np.array(z1_gripper.HALF_WIDTH).T)
            assert np.abs(near[:, 1]).max() == pytest.approx(half, abs=0.003)


def test_a_bar_is_held_and_its_width_told():
    check = check_grasps(BAR, around_the_bar(), HAND, np.array([0.03]))
    assert check.valid.all()
    assert check.widths_m == pytest.approx([0.03], abs=1e-3)


def test_the_object_is_pushed_to_the_fixed_jaw():
    """The turning jaw shoves the bar over to the fixed one, however far it stood off."""
    middle = check_grasps(BAR, around_the_bar(), HAND, np.array([0.03]))
    aside = check_grasps(BAR, around_the_bar(at_y=-0.006), HAND, np.array([0.03]))
    assert aside.valid.all()
    assert middle.offsets_m == pytest.approx([0.0], abs=1e-3)
    assert aside.offsets_m == pytest.approx([0.006], abs=1e-3)


def test_a_jaw_laid_around_too_small_a_width_stands_in_the_object():
    assert not check_grasps(BAR, around_the_bar(), HAND, np.array([0.008])).free.any()


def test_a_beak_turned_over_is_another_grasp():
    """Beside the fixed jaw there is room for a shelf where the opened turning jaw would stand in it."""
    shelf = make_part(BOX, (0.05, 0.006, 0.10), origin=(0.0, -0.055, 0.0))
    solid = make_solid("bar beside a shelf", [make_part(BOX, (0.012, 0.015, 0.10)), shelf])
    T = around_the_bar()
    over = T @ np.diag([-1.0, -1.0, 1.0, 1.0])
    width = np.array([0.03])
    assert check_grasps(solid, T, HAND, width).free.all()
    assert not check_grasps(solid, over, HAND, width).free.any()


def test_a_grasp_askew_beyond_friction_does_not_hold():
    assert not check_grasps(BAR, around_the_bar(turned=0.7), HAND, np.array([0.03])).valid.any()


def test_a_beak_without_widths_cannot_be_checked():
    with pytest.raises(ValueError, match="widths_m"):
        check_grasps(BAR, around_the_bar(), HAND)


@pytest.mark.parametrize("family", ["capsule", "l_shape", "hammer"])
def test_ground_truth_for_the_beak_holds_and_fits_the_runtimes_beak(family):
    solid = make_shape(family, np.random.default_rng(6))
    T, widths = find_grasps(solid, HAND, np.random.default_rng(0))
    assert len(T) > 30
    assert check_grasps(solid, T, HAND, widths).valid.mean() > 0.9
    assert BeakGripper().fit_batch(T, widths).fits.all()

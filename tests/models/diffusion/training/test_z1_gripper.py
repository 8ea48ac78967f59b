"""The Z1's gripper in the training: fitted as in the runtime, and closing from one side."""

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from models.diffusion.training import z1_gripper
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labels import check_grasps, find_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.solids import BOX, make_part, make_solid
from tests.support.errors import raises
from z1_runtime.geometry.gripper_geometry import GripperPlacementConfig, gripper_shape
from z1_runtime.grasping.beak_gripper import BeakGripper

GRIPPER = GRIPPERS["z1"]
assert isinstance(GRIPPER, z1_gripper.Z1GripperSpec)
BAR = make_solid("box", [make_part(BOX, (0.012, 0.015, 0.10))])


def around_the_bar(at_y: float = 0.0, turned: float = 0.0) -> np.ndarray:
    """Return a grasp that closes along y and comes along −x, its contacts 12 mm before its origin."""
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)
    c, s = np.cos(turned), np.sin(turned)
    T[:3, :3] = T[:3, :3] @ np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    T[:3, 3] = (-0.012, at_y, 0.0)
    return T[None]


@pytest.mark.integration
def test_the_fit_around_a_width_is_the_runtimes():
    runtime = BeakGripper()
    assert GripperPlacementConfig().contact_depth_m == z1_gripper.CONTACT_DEPTH_M
    for width in np.arange(0.004, 0.084, 0.012):
        expected, _ = runtime.fit(np.eye(4), float(width))
        T_pivot, opening = z1_gripper._place(np.eye(4), np.array(z1_gripper.GRIPPER_FIT), width)
        assert T_pivot[:3, 3] == pytest.approx(expected.T_base_pivot[:3, 3], abs=2e-3)
        assert T_pivot[:3, :3] == pytest.approx(expected.T_base_pivot[:3, :3], abs=0.02)
        assert -opening == pytest.approx(expected.jaw_open, abs=0.01)
        assert np.linalg.det(T_pivot[:3, :3]) == pytest.approx(1.0)


def test_the_outer_sides_are_those_of_the_meshes():
    shape = gripper_shape()
    for points, outline, lowest in (
        (shape.fixed, z1_gripper.STATIONARY_BACK, True),
        (shape.moving_jaw, z1_gripper.MOVING_BACK, False),
    ):
        for x, z in outline[:-1]:
            near = points[(np.abs(points[:, 0] - x) < 0.006) & (np.abs(points[:, 1]) < 0.042)]
            assert (near[:, 2].min() if lowest else near[:, 2].max()) == pytest.approx(z, abs=0.004)
            half = np.interp(x, *z1_gripper.HALF_WIDTH.T)
            assert np.abs(near[:, 1]).max() == pytest.approx(half, abs=0.003)


@pytest.mark.integration
def test_a_bar_is_held_and_its_width_reported():
    check = check_grasps(BAR, around_the_bar(), GRIPPER, np.array([0.03]))
    assert check.valid.all()
    assert check.widths_m == pytest.approx([0.03], abs=1e-3)


def test_the_object_is_pushed_to_the_stationary_jaw():
    """The moving jaw pushes the bar to the stationary one from any distance."""
    middle = check_grasps(BAR, around_the_bar(), GRIPPER, np.array([0.03]))
    off_middle = check_grasps(BAR, around_the_bar(at_y=-0.006), GRIPPER, np.array([0.03]))
    assert off_middle.valid.all()
    assert middle.offsets_m == pytest.approx([0.0], abs=1e-3)
    assert off_middle.offsets_m == pytest.approx([0.006], abs=1e-3)


def test_a_fit_around_too_small_a_width_collides():
    assert not check_grasps(BAR, around_the_bar(), GRIPPER, np.array([0.008])).free.any()


def test_the_gripper_turned_over_is_another_grasp():
    """Next to the stationary jaw a shelf fits that the opened moving jaw would hit."""
    shelf = make_part(BOX, (0.05, 0.006, 0.10), origin=(0.0, -0.055, 0.0))
    solid = make_solid("bar next to a shelf", [make_part(BOX, (0.012, 0.015, 0.10)), shelf])
    T = around_the_bar()
    over = T @ np.diag([-1.0, -1.0, 1.0, 1.0])
    width = np.array([0.03])
    assert check_grasps(solid, T, GRIPPER, width).free.all()
    assert not check_grasps(solid, over, GRIPPER, width).free.any()


def test_a_grasp_outside_the_friction_cone_is_invalid():
    assert not check_grasps(BAR, around_the_bar(turned=0.7), GRIPPER, np.array([0.03])).valid.any()


def test_a_check_without_widths_is_rejected():
    with raises(InvalidValueError, "widths_missing"):
        check_grasps(BAR, around_the_bar(), GRIPPER)


@pytest.mark.parametrize("family", ["capsule", "l_shape", "hammer"])
def test_ground_truth_is_valid_and_fits_the_runtimes_gripper(family):
    solid = make_shape(family, np.random.default_rng(6))
    T, widths = find_grasps(solid, GRIPPER, np.random.default_rng(0))
    assert len(T) > 30
    assert check_grasps(solid, T, GRIPPER, widths).valid.mean() > 0.9
    assert BeakGripper().fit_batch(T, widths).fits.all()

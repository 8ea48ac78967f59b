from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from hal.base import z1
from sim_twin.model.parts import load_link_mesh, split_convex
from sim_twin.model.world import World
from sim_twin.model.z1_mjcf import add_z1

LINKS = ("link01", "link02", "link03", "link04", "link05", "link06", "gripperStator", "gripperMover")


def test_every_link_and_the_pivot_are_where_pinocchio_puts_them(world: World) -> None:
    reference = pin.buildModelFromUrdf(str(z1.urdf_path()))
    reference_data, data = reference.createData(), mujoco.MjData(world.model)
    rng = np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform(z1.Q_MIN, z1.Q_MAX)
        data.qpos[: z1.N_JOINTS] = q
        mujoco.mj_kinematics(world.model, data)
        pin.framesForwardKinematics(reference, reference_data, q)
        for link in LINKS:
            expected = reference_data.oMf[reference.getFrameId(link, pin.FrameType.BODY)].homogeneous
            np.testing.assert_allclose(data.body(link).xmat.reshape(3, 3), expected[:3, :3], atol=1e-9)
            np.testing.assert_allclose(data.body(link).xpos, expected[:3, 3], atol=1e-9)
        T_base_flange = reference_data.oMf[reference.getFrameId("link06", pin.FrameType.BODY)].homogeneous
        np.testing.assert_allclose(
            data.body("gripperMover").xpos, (T_base_flange @ z1.T_FLANGE_PIVOT)[:3, 3], atol=1e-9
        )


def test_the_camera_sits_where_the_mount_is_drawn(world: World) -> None:
    data = world.snapshot()
    flange, camera = data.body("link06"), data.cam("wrist")
    T_base_flange = np.eye(4)
    T_base_flange[:3, :3], T_base_flange[:3, 3] = flange.xmat.reshape(3, 3), flange.xpos
    T_base_camera = T_base_flange @ z1.T_FLANGE_CAMERA
    np.testing.assert_allclose(camera.xpos, T_base_camera[:3, 3], atol=1e-9)
    np.testing.assert_allclose(camera.xmat.reshape(3, 3) * [1, -1, -1], T_base_camera[:3, :3], atol=1e-9)


def test_limits_gains_and_efforts_are_those_of_the_robot_facts(world: World) -> None:
    for index, name in enumerate(z1.JOINT_NAMES):
        joint, actuator = world.model.joint(name), world.model.actuator(name)
        assert joint.qposadr[0] == joint.dofadr[0] == actuator.id == index
        np.testing.assert_allclose(joint.range, [z1.Q_MIN[index], z1.Q_MAX[index]])
        np.testing.assert_allclose(world.model.jnt_actfrcrange[joint.id], [-z1.TAU_MAX[index], z1.TAU_MAX[index]])
        np.testing.assert_allclose(actuator.biasprm[:3], [0.0, -z1.KP[index], -z1.KD[index]])


def test_masses_are_the_urdfs_plus_a_hundred_grams_of_camera(world: World) -> None:
    root = ElementTree.parse(z1.urdf_path()).getroot()
    urdf = {link.get("name"): link.find("inertial/mass") for link in root.findall("link")}
    for name, mass in urdf.items():
        if mass is not None:
            assert world.model.body(name).mass[0] == pytest.approx(float(mass.get("value", "nan")))
    mount = world.model.body("camera").mass[0] + world.model.body("camera_bracket").mass[0]
    assert mount == pytest.approx(0.100)


def test_inertias_places_axes_and_damping_are_the_urdfs_to_the_last_bit() -> None:
    def numbers(element, key: str) -> list[float]:
        return [float(part) for part in element.get(key).split()]

    spec = mujoco.MjSpec()
    for material in ("link", "dark", "jaw", "camera", "bracket"):
        spec.add_material(name=material)
    add_z1(spec)
    root = ElementTree.parse(z1.urdf_path()).getroot()
    for link in root.findall("link[inertial]"):
        body, inertial = spec.body(link.get("name")), link.find("inertial")
        assert body.mass == float(inertial.find("mass").get("value"))
        assert body.ipos.tolist() == numbers(inertial.find("origin"), "xyz")
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        assert body.fullinertia.tolist() == [float(inertial.find("inertia").get(key)) for key in keys]
    for joint in root.findall("joint[parent]"):
        body = spec.body(joint.find("child").get("link"))
        assert body.pos.tolist() == numbers(joint.find("origin"), "xyz")
        assert len(body.joints) == (joint.get("type") == "revolute")
        for own in body.joints:
            assert own.axis.tolist() == numbers(joint.find("axis"), "xyz")
            assert own.damping[0] == float(joint.find("dynamics").get("damping"))


@pytest.mark.parametrize(("jaw", "offset", "side"), [("gripperStator", 0.049, 1.0), ("gripperMover", 0.0, -1.0)])
def test_no_convex_piece_of_a_jaw_bulges_into_the_opening(jaw: str, offset: float, side: float) -> None:
    """From 35 to 99 mm along x the pieces' inner face is compared with the mesh cut at y = 0."""
    flip = np.array([1.0, 1.0, side])
    lines = trimesh.intersections.mesh_plane(load_link_mesh(jaw), [0, 1, 0], [0, 5e-4, 0])[:, :, [0, 2]]
    lines = lines * flip[[0, 2]] - [offset, 0.0]
    lines = lines[(lines[:, :, 1] < (0.002 if side > 0 else 0.012)).all(axis=1)]
    pieces = [corners * flip - [offset, 0.0, 0.0] for corners in split_convex(jaw)]
    for x in np.arange(0.036, 0.0985, 0.002):
        (x0, z_0), (x1, z_1) = np.moveaxis(
            lines[(lines[:, :, 0].min(axis=1) <= x) & (lines[:, :, 0].max(axis=1) > x)], 0, 2
        )
        inner = (z_0 + (x - x0) / (x1 - x0) * (z_1 - z_0)).max()
        outer = max(_height_at(piece, x) for piece in pieces if piece[:, 0].min() <= x <= piece[:, 0].max())
        assert -6e-4 < outer - inner < 6e-4


def _height_at(corners: np.ndarray, x: float) -> float:
    """Return the highest z of the hull of `corners` at `x`, over all y."""
    left, right = corners[corners[:, 0] <= x + 1e-9], corners[corners[:, 0] >= x - 1e-9]
    width = right[None, :, 0] - left[:, None, 0]
    share = np.where(width > 1e-9, (x - left[:, None, 0]) / np.maximum(width, 1e-9), 0.0)
    return float((left[:, None, 2] + share * (right[None, :, 2] - left[:, None, 2])).max())

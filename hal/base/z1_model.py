"""Rigid-body model of the Z1, loaded once from its URDF by pinocchio, and its forward kinematics."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports] - a .pth file leads to it

from hal.base import z1


@cache
def rigid_body_model() -> pin.Model:
    """Return the Z1 with its gripper, seven joints, and the frame `pivot` (`hal.base.z1.T_FLANGE_PIVOT` on link06).

    The model is shared and must not be changed; `model.createData()` gives each thread its own scratch memory.
    """
    model = pin.buildModelFromUrdf(str(z1.urdf_path()))
    flange_id = model.getFrameId("link06")
    flange = model.frames[flange_id]
    placement = flange.placement * pin.SE3(np.array(z1.T_FLANGE_PIVOT))
    model.addFrame(pin.Frame("pivot", flange.parentJoint, flange_id, placement, pin.FrameType.OP_FRAME))
    return model


def joint_placements() -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the pose of each arm joint in its parent link at angle 0, (6, 4, 4), and the axes they turn about."""
    model = rigid_body_model()
    joints = [model.getJointId(name) for name in z1.JOINT_NAMES[: z1.N_ARM]]
    placements = np.array([model.jointPlacements[joint].homogeneous for joint in joints])
    return placements, tuple(model.joints[joint].shortname()[-1] for joint in joints)


class ForwardKinematics:
    """Poses of the links for given joints; one object belongs to one thread, as its scratch memory does."""

    def __init__(self) -> None:
        self._model = rigid_body_model()
        self._pivot_id = self._model.getFrameId("pivot")
        self._links = {
            frame.name: index for index, frame in enumerate(self._model.frames) if frame.type == pin.FrameType.BODY
        }
        self._data = self._model.createData()
        self._q_full = np.zeros(self._model.nq)

    def pivot(self, q: np.ndarray) -> np.ndarray:
        """Return T_base_pivot (4, 4) at arm joints `q` (6,) [rad]."""
        return self._frame(q, self._pivot_id)

    def flange(self, q: np.ndarray) -> np.ndarray:
        """Return T_base_flange (4, 4) at arm joints `q` (6,) [rad]."""
        return self._frame(q, self._links["link06"])

    def link_poses(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Return T_base_link (4, 4) of every URDF link at joints `q` (7,) [rad], by link name.

        The names are `link00` to `link06`, `gripperStator` and `gripperMover`, and the massless `world`.
        """
        pin.framesForwardKinematics(self._model, self._data, np.asarray(q, dtype=np.float64))
        return {name: self._data.oMf[index].homogeneous for name, index in self._links.items()}

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the (6, 6) Jacobian of the pivot at `q` (6,): linear rows first, then angular, in base axes."""
        self._q_full[: z1.N_ARM] = q
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return pin.computeFrameJacobian(self._model, self._data, self._q_full, self._pivot_id, frame)[:, : z1.N_ARM]

    def _frame(self, q: np.ndarray, frame_id: int) -> np.ndarray:
        self._q_full[: z1.N_ARM] = q
        pin.forwardKinematics(self._model, self._data, self._q_full)
        return pin.updateFramePlacement(self._model, self._data, frame_id).homogeneous

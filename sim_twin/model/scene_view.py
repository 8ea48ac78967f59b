"""Read access to a scene at a moment, wherever its physics run."""

from __future__ import annotations

from abc import ABC, abstractmethod

import mujoco
import numpy as np

from hal.base import z1
from sim_twin.model.scene import SceneConfig


class SceneView(ABC):
    """A scene's poses: of a world in this process, or of another's.

    Args:
        config: of the scene.
    """

    start_height_m: float
    """Height of the object's lowest point at the start [m]."""

    def __init__(self, config: SceneConfig) -> None:
        self.config = config
        self._corners = config.grasp_object.corners()

    @property
    @abstractmethod
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model of the scene."""

    @abstractmethod
    def poses(self) -> tuple[float, np.ndarray]:
        """Return MuJoCo's time [s] and positions (14 + 7 N,): joints [rad], then position [m] and quaternion (wxyz) of
        the object and of each of its N neighbours."""

    def T_base_object(self) -> np.ndarray:
        """Return the object's pose (4, 4): origin at mid-height on its axis, z along the axis."""
        _, qpos = self.poses()
        pose, rotation = np.eye(4), np.empty(9)
        mujoco.mju_quat2Mat(rotation, qpos[z1.N_JOINTS + 3 : z1.N_JOINTS + 7])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), qpos[z1.N_JOINTS : z1.N_JOINTS + 3]
        return pose

    def lifted_m(self) -> float:
        """Return the rise of the object's lowest point since the start [m]."""
        return self.lowest_m() - self.start_height_m

    def lowest_m(self) -> float:
        """Return the height of the object's lowest point [m]."""
        pose = self.T_base_object()
        return float((self._corners @ pose[2, :3]).min() + pose[2, 3])

    def snapshot(self, into: mujoco.MjData | None = None) -> mujoco.MjData:
        """Return the present poses in a copy of the state that no step will touch.

        Args:
            into: an earlier snapshot to write over, to save the allocation.
        """
        copy = into if into is not None else mujoco.MjData(self.model)
        copy.time, copy.qpos[:] = self.poses()
        mujoco.mj_kinematics(self.model, copy)
        # MuJoCo computes cameras and lights after the centres of mass, which they may track
        mujoco.mj_comPos(self.model, copy)
        mujoco.mj_camlight(self.model, copy)
        return copy

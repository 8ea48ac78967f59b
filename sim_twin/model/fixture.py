"""Break-away fixture that holds a leaning object until the gripper takes it."""

from __future__ import annotations

import mujoco
import numpy as np

from sim_twin.model.convex import JAW_LINKS
from sim_twin.model.objects import OBJECT_BODY
from sim_twin.model.scene import FIXTURE

BREAK_FORCE_N = 5.0
BREAK_TRAVEL_M = 0.015
_GRIP_FORCE_N = 1.0


class Fixture:
    """A weld to the world that releases once and for all.

    It releases when the arm pushes the object with more than 5 N, when the object has moved 15 mm, or when both jaws
    press on it with more than 1 N.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._id = model.equality(FIXTURE).id
        self._object = model.body(OBJECT_BODY).id
        self._jaws = [model.body(name).id for name in JAW_LINKS]
        self._start = model.body(OBJECT_BODY).pos.copy()

    def update(self, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        """Release the object if a limit is exceeded; return True once released."""
        moved = np.linalg.norm(data.xpos[self._object] - self._start) > BREAK_TRAVEL_M
        forces = self._forces_by_body(model, data) if not moved else {}
        gripped = all(np.linalg.norm(forces.get(jaw, 0.0)) > _GRIP_FORCE_N for jaw in self._jaws)
        pushed = np.linalg.norm(sum(forces.values(), np.zeros(3))) > BREAK_FORCE_N
        if moved or gripped or pushed:
            data.eq_active[self._id] = 0
            return True
        return False

    def _forces_by_body(self, model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, np.ndarray]:
        """Return the contact force [N] on the object from each body of the arm, in the base frame."""
        forces: dict[int, np.ndarray] = {}
        wrench = np.empty(6)
        bodies = model.geom_bodyid[data.contact.geom]
        for index in np.flatnonzero((bodies == self._object).any(axis=1)):
            first, second = bodies[index]
            other = int(second if first == self._object else first)
            # Body 0 is the world with the table, whose support is no push
            if other == 0:
                continue
            mujoco.mj_contactForce(model, data, int(index), wrench)
            # MuJoCo stores the contact frame's axes in rows, the normal first
            force = data.contact.frame[index].reshape(3, 3).T @ wrench[:3]
            # The contact force acts on the second geom along the frame's axes.
            forces[other] = forces.get(other, np.zeros(3)) + (force if second == self._object else -force)
        return forces

"""What an impartial observer of the twin writes down while the arm acts."""

from __future__ import annotations

import mujoco
import numpy as np

from sim_twin.convex import JAW_LINKS
from sim_twin.objects import OBJECT_BODY
from sim_twin.world import World

_EVERY_TICKS = 5


class Watch:
    """Looks at the world every 10 ms; to be called every control period."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._ticks = 0
        model = world.model
        self._object = model.body(OBJECT_BODY).id
        self._stator = model.body(JAW_LINKS[0]).id
        self._jaws = np.array([model.body(name).id for name in JAW_LINKS])
        self._table = model.geom("table").id
        # The base stands on the table for good; everything else of the arm has no business there.
        self._base = model.body("link00").id
        self._start = world.T_base_object()
        self.lifted_m: list[float] = []
        """Since the last `clear` [m]."""
        self.table_force_n = 0.0
        """Most force between arm and table so far [N]."""
        self.displacement_m = 0.0
        """Most that the object's origin has moved so far [m]."""
        self.tilt_rad = 0.0
        """Most that the object's axis has turned so far [rad]."""

    def tick(self) -> None:
        """Look, if it is time to."""
        self._ticks += 1
        if self._ticks % _EVERY_TICKS:
            return
        pose = self._world.T_base_object()
        self.lifted_m.append(self._world.lifted_m())
        self.displacement_m = max(self.displacement_m, float(np.linalg.norm(pose[:3, 3] - self._start[:3, 3])))
        self.tilt_rad = max(self.tilt_rad, float(np.arccos(np.clip(pose[:3, 2] @ self._start[:3, 2], -1.0, 1.0))))
        self.table_force_n = max(self.table_force_n, self._force_on_table())

    def clear(self) -> None:
        """Forget the heights seen so far."""
        self.lifted_m.clear()

    def T_hand_object(self) -> np.ndarray:
        """Return the object's pose (4, 4) in the frame of the fixed jaw."""
        data = self._world.data
        R, p = data.xmat[self._stator].reshape(3, 3), data.xpos[self._stator]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, p
        return np.linalg.inv(T) @ self._world.T_base_object()

    def jaws_touching(self) -> int:
        """Return how many of the two jaws touch the object."""
        bodies = self._bodies()
        touching = bodies[(bodies == self._object).any(axis=1)]
        return sum(bool((touching == jaw).any()) for jaw in self._jaws)

    def _bodies(self) -> np.ndarray:
        return self._world.model.geom_bodyid[self._world.data.contact.geom]

    def _force_on_table(self) -> float:
        model, data = self._world.model, self._world.data
        geoms, bodies = data.contact.geom, self._bodies()
        on_table = (geoms == self._table).any(axis=1) & ~np.isin(bodies, (self._object, self._base)).any(axis=1)
        most, wrench = 0.0, np.empty(6)
        for index in np.flatnonzero(on_table):
            mujoco.mj_contactForce(model, data, int(index), wrench)
            most = max(most, float(np.linalg.norm(wrench[:3])))
        return most

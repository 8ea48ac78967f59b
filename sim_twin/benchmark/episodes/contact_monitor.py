"""Monitor of the object's motion and contacts in the twin during an episode."""

from __future__ import annotations

import mujoco
import numpy as np

from sim_twin.model.objects import OBJECT_BODY
from sim_twin.model.parts import JAW_LINKS
from sim_twin.model.scene import neighbour_body
from sim_twin.model.world import World

KNOCKED_M, KNOCKED_RAD = 0.015, np.radians(15.0)
"""Displacement and turn above which an object counts as knocked."""
_EVERY_TICKS = 5  # control periods of 2 ms


class ContactMonitor:
    """Samples the world every 10 ms; `tick` is to be called every control period."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._ticks = 0
        model = world.model
        self._object = model.body(OBJECT_BODY).id
        self._stationary_jaw = model.body(JAW_LINKS[0]).id
        self._jaws = np.array([model.body(name).id for name in JAW_LINKS])
        self._table = model.geom("table").id
        self._neighbours = [model.body(neighbour_body(n)).id for n in range(len(world.config.neighbours))]
        # The base is mounted on the table; a contact of any other link is a collision.
        self._may_touch_table = np.zeros(model.nbody, dtype=bool)
        self._may_touch_table[[self._object, model.body("link00").id, *self._neighbours]] = True
        self._neighbours_start = [self._pose(body) for body in self._neighbours]
        self.begin()

    def begin(self) -> None:
        """Reset all figures: an attempt begins now."""
        self._start = self._world.T_base_object()
        self.lifted_m: list[float] = []
        """Since the last `clear` [m]."""
        self.table_force_n = 0.0
        """Maximum force between arm and table so far [N]."""
        self.displacement_m = 0.0
        """Maximum displacement of the object's origin so far [m]."""
        self.tilt_rad = 0.0
        """Maximum turn of the object's axis so far [rad]."""

    def tick(self) -> None:
        """Sample the world on every fifth call."""
        self._ticks += 1
        if self._ticks % _EVERY_TICKS:
            return
        pose = self._world.T_base_object()
        self.lifted_m.append(self._world.lifted_m())
        moved_m, turned_rad = _displacement(self._start, pose)
        self.displacement_m, self.tilt_rad = max(self.displacement_m, moved_m), max(self.tilt_rad, turned_rad)
        self.table_force_n = max(self.table_force_n, self._force_on_table())

    def clear(self) -> None:
        """Discard the heights sampled so far."""
        self.lifted_m.clear()

    def T_gripper_object(self) -> np.ndarray:
        """Return the object's pose (4, 4) in the frame of the stationary jaw."""
        return np.linalg.inv(self._pose(self._stationary_jaw)) @ self._world.T_base_object()

    def neighbours_knocked(self) -> int:
        """Return the number of neighbours knocked since the episode began."""
        displacements = [
            _displacement(start, self._pose(body))
            for start, body in zip(self._neighbours_start, self._neighbours, strict=True)
        ]
        return sum(bool(moved_m > KNOCKED_M or turned_rad > KNOCKED_RAD) for moved_m, turned_rad in displacements)

    def jaws_touching(self) -> int:
        """Return the number of jaws, 0 to 2, in contact with the object."""
        bodies = self._bodies()
        touching = bodies[(bodies == self._object).any(axis=1)]
        return sum(bool((touching == jaw).any()) for jaw in self._jaws)

    def _pose(self, body: int) -> np.ndarray:
        """Return the pose (4, 4) of a body."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._world.data.xmat[body].reshape(3, 3), self._world.data.xpos[body]
        return T

    def _bodies(self) -> np.ndarray:
        return self._world.model.geom_bodyid[self._world.data.contact.geom]

    def _force_on_table(self) -> float:
        model, data = self._world.model, self._world.data
        geoms, bodies = data.contact.geom, self._bodies()
        on_table = (geoms == self._table).any(axis=1) & ~self._may_touch_table[bodies].any(axis=1)
        max_force_n, wrench = 0.0, np.empty(6)
        for index in np.flatnonzero(on_table):
            mujoco.mj_contactForce(model, data, int(index), wrench)
            # The first three entries are the force, the others the torque
            max_force_n = max(max_force_n, float(np.linalg.norm(wrench[:3])))
        return max_force_n


def _displacement(start: np.ndarray, now: np.ndarray) -> tuple[float, float]:
    """Return displacement [m] of the origin and turn [rad] of the z axis between two poses (4, 4)."""
    # Rounding may take the product of two unit vectors beyond 1
    turned_rad = float(np.arccos(np.clip(now[:3, 2] @ start[:3, 2], -1.0, 1.0)))
    return float(np.linalg.norm(now[:3, 3] - start[:3, 3])), turned_rad

"""The simulated world: one arm, one table, one object, moved forward one control period at a time."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod

import mujoco
import numpy as np

from hal.base import z1
from sim_twin.model.objects import OBJECT_BODY
from sim_twin.model.parts import JAW_LINKS
from sim_twin.model.scene import FIXTURE, PHYSICS_PERIOD_S, SceneConfig, build_model


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


GRIPPER_START_RAD = -1.0
KP_MOTOR_MAX, KD_MOTOR_MAX = 1e4, 1e3
"""Limits of a motor's gains [Nm/rad], [Nm s/rad]: thirteen times the vendor's highest, and more."""
_CTRL_MAX = 1e9
"""MuJoCo rejects 1e10 as a mistake; the effort limit is far below."""
_SUBSTEPS = round(z1.CONTROL_PERIOD_S / PHYSICS_PERIOD_S)
_SETTLE_STEPS = 100


class World(SceneView):
    """Physics behind a lock: one thread steps it, others may take snapshots.

    The arm starts at home with the jaws open by 1 rad; the object has settled.

    Args:
        config: of the scene.
        q_start: (7,) start of the arm, by default home [rad].
    """

    def __init__(self, config: SceneConfig, q_start: np.ndarray | None = None) -> None:
        super().__init__(config)
        self._model = build_model(config)
        self.data = mujoco.MjData(self.model)
        self._lock = threading.RLock()
        self._steps = 0
        self._fixture = Fixture(self.model) if config.is_held else None
        self._gravcomp = self.model.body_gravcomp.copy()
        start = np.append(z1.Q_HOME, GRIPPER_START_RAD) if q_start is None else q_start
        self.data.qpos[: z1.N_JOINTS] = start
        self.set_command(start, np.zeros(z1.N_JOINTS))
        for _ in range(_SETTLE_STEPS):
            self.step()
        self._steps, self.data.time = 0, 0.0
        # mj_step ends with the integration: without this, poses and contacts would be those of the step before
        mujoco.mj_forward(self.model, self.data)
        self.start_height_m = self.lowest_m()

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model of the scene."""
        return self._model

    @property
    def time_s(self) -> float:
        """Simulated time [s]: whole control periods, free of rounding that adds up."""
        return self._steps * z1.CONTROL_PERIOD_S

    def step(self) -> None:
        """Advance by one control period (2 ms)."""
        with self._lock:
            mujoco.mj_step(self.model, self.data, nstep=_SUBSTEPS)
            self._steps += 1
            if self._fixture is not None and self._fixture.update(self.model, self.data):
                self._fixture = None

    def advance_to(self, t_s: float) -> None:
        """Step until `time_s >= t_s` [s]."""
        # Times are whole steps times the period, up to rounding
        while self.time_s < t_s - 1e-9:
            self.step()

    def place_arm(self, q: np.ndarray) -> None:
        """Put the joints at `q` (7,) [rad], at rest and without physics, in a world that no step moves."""
        with self._lock:
            self.data.qpos[: z1.N_JOINTS] = q
            self.data.qvel[: z1.N_JOINTS] = 0.0

    def set_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Set the servos' targets: positions (7,) [rad] and velocities (7,) [rad/s]."""
        with self._lock:
            self._set_servos(z1.KP, z1.KD, self._gravcomp)
            self.data.ctrl[:] = z1.KP * q + z1.KD * dq

    def set_motors(
        self,
        q: np.ndarray,
        dq: np.ndarray,
        tau: np.ndarray,
        kp: np.ndarray,
        kd: np.ndarray,
        *,
        tau_max: np.ndarray = z1.TAU_MAX,
    ) -> None:
        """Let each motor make tau + kp · (q − q_measured) + kd · (dq − dq_measured), up to its effort limit, without
        gravity compensation.

        Args:
            q: (7,) [rad].
            dq: (7,) [rad/s].
            tau: (7,) [Nm].
            kp: (7,) [Nm/rad]; from 0 to `KP_MOTOR_MAX`, beyond which physics would not be stable.
            kd: (7,) [Nm s/rad]; from 0 to `KD_MOTOR_MAX`.
            tau_max: (7,) the effort limits [Nm].
        """
        kp, kd = np.clip(kp, 0.0, KP_MOTOR_MAX), np.clip(kd, 0.0, KD_MOTOR_MAX)
        with self._lock:
            # The vendor's controller carries the weight by its own torque command
            self._set_servos(kp, kd, 0.0, tau_max)
            self.data.ctrl[:] = np.clip(tau + kp * q + kd * dq, -_CTRL_MAX, _CTRL_MAX)

    def _set_servos(
        self, kp: np.ndarray, kd: np.ndarray, gravcomp: np.ndarray | float, tau_max: np.ndarray = z1.TAU_MAX
    ) -> None:
        self.model.jnt_actfrcrange[: z1.N_JOINTS] = np.stack([-tau_max, tau_max], axis=1)
        self.model.actuator_biasprm[:, 1] = -kp
        self.model.actuator_biasprm[:, 2] = -kd
        self.model.body_gravcomp[:] = gravcomp

    def read_arm(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions [rad], velocities [rad/s] and motor torques [Nm], each (7,)."""
        with self._lock:
            n = z1.N_JOINTS
            # qfrc_actuator includes gravity compensation, since the joints have `actgravcomp`
            return self.data.qpos[:n].copy(), self.data.qvel[:n].copy(), self.data.qfrc_actuator[:n].copy()

    def poses(self) -> tuple[float, np.ndarray]:
        """Return MuJoCo's time [s] and positions (14 + 7 N,), as `SceneView.poses` says."""
        with self._lock:
            return float(self.data.time), self.data.qpos.copy()

    @property
    def fixture_holds(self) -> bool:
        """True while the break-away fixture of a leaning object has not released it."""
        return self._fixture is not None

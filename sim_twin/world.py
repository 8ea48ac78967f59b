"""The simulated world: one arm, one table, one object, moved forward one control period at a time."""

from __future__ import annotations

import threading

import mujoco
import numpy as np

from hal import z1
from sim_twin.fixture import Fixture
from sim_twin.objects import OBJECTS
from sim_twin.scene import PHYSICS_PERIOD_S, SceneConfig, build_model

GRIPPER_START_RAD = -1.0
KP_MOTOR_MAX, KD_MOTOR_MAX = 1e4, 1e3
"""What a motor's gains are cut to [Nm/rad], [Nm s/rad]: thirteen times the vendor's highest, and more."""
_CTRL_MAX = 1e9
"""MuJoCo takes 1e10 for a mistake; the effort limit is met long before."""
_SUBSTEPS = round(z1.CONTROL_PERIOD_S / PHYSICS_PERIOD_S)
_SETTLE_STEPS = 100


class World:
    """Physics behind a lock: one thread steps it, others may take snapshots.

    The arm starts at home with the jaws open by 1 rad; the object has settled.

    Args:
        config: what stands where.
        q_start: (7,) where the arm starts instead [rad].
    """

    def __init__(self, config: SceneConfig, q_start: np.ndarray | None = None) -> None:
        self.config = config
        self.model = build_model(config)
        self.data = mujoco.MjData(self.model)
        self._lock = threading.RLock()
        self._steps = 0
        self._corners = OBJECTS[config.object].corners()
        self._fixture = Fixture(self.model) if config.pitch_deg != 0 else None
        self._gravcomp = self.model.body_gravcomp.copy()
        start = np.append(z1.Q_HOME, GRIPPER_START_RAD) if q_start is None else q_start
        self.data.qpos[: z1.N_JOINTS] = start
        self.set_command(start, np.zeros(z1.N_JOINTS))
        for _ in range(_SETTLE_STEPS):
            self.step()
        self._steps, self.data.time = 0, 0.0
        mujoco.mj_forward(self.model, self.data)
        self._start_height_m = self._lowest_m()

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
        while self.time_s < t_s - 1e-9:
            self.step()

    def set_command(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Set where the servos pull to: positions (7,) [rad] and velocities (7,) [rad/s]."""
        with self._lock:
            self._set_servos(z1.KP, z1.KD, self._gravcomp)
            self.data.ctrl[:] = z1.KP * q + z1.KD * dq

    def set_motors(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> None:
        """Let each motor make tau + kp · (q − q_measured) + kd · (dq − dq_measured), up to its effort limit; nothing
        carries the arm besides.

        Args:
            q: (7,) [rad].
            dq: (7,) [rad/s].
            tau: (7,) [Nm].
            kp: (7,) [Nm/rad]; from 0 to `KP_MOTOR_MAX`, beyond which physics would not be stable.
            kd: (7,) [Nm s/rad]; from 0 to `KD_MOTOR_MAX`.
        """
        kp, kd = np.clip(kp, 0.0, KP_MOTOR_MAX), np.clip(kd, 0.0, KD_MOTOR_MAX)
        with self._lock:
            self._set_servos(kp, kd, 0.0)
            self.data.ctrl[:] = np.clip(tau + kp * q + kd * dq, -_CTRL_MAX, _CTRL_MAX)

    def _set_servos(self, kp: np.ndarray, kd: np.ndarray, gravcomp: np.ndarray | float) -> None:
        self.model.actuator_biasprm[:, 1] = -kp
        self.model.actuator_biasprm[:, 2] = -kd
        self.model.body_gravcomp[:] = gravcomp

    def read_arm(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions [rad], velocities [rad/s] and motor torques [Nm], each (7,)."""
        with self._lock:
            n = z1.N_JOINTS
            return self.data.qpos[:n].copy(), self.data.qvel[:n].copy(), self.data.qfrc_actuator[:n].copy()

    def T_base_object(self) -> np.ndarray:
        """Return the object's pose (4, 4): origin at mid-height on its axis, z along the axis."""
        with self._lock:
            pose = np.eye(4)
            position, quat = self.data.qpos[z1.N_JOINTS : z1.N_JOINTS + 3], self.data.qpos[z1.N_JOINTS + 3 :]
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, quat)
            pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
            return pose

    def lifted_m(self) -> float:
        """Return how much higher the object's lowest point is than at the start [m]."""
        return float(self._lowest_m() - self._start_height_m)

    @property
    def fixture_holds(self) -> bool:
        """True while the break-away fixture of a leaning object has not let go."""
        return self._fixture is not None

    def snapshot(self, into: mujoco.MjData | None = None) -> mujoco.MjData:
        """Return the present poses in a copy of the state that no step will touch.

        Args:
            into: an earlier snapshot to write over, to save the allocation.
        """
        copy = into if into is not None else mujoco.MjData(self.model)
        with self._lock:
            copy.qpos[:] = self.data.qpos
            copy.time = self.data.time
        mujoco.mj_kinematics(self.model, copy)
        mujoco.mj_comPos(self.model, copy)
        mujoco.mj_camlight(self.model, copy)
        return copy

    def _lowest_m(self) -> float:
        pose = self.T_base_object()
        return float((self._corners @ pose[2, :3]).min() + pose[2, 3])

"""The public Python API: one robot, simulated or connected, that delivers frames, moves, and picks objects."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hal.base import z1
from hal.base.clock import Clock
from hal.base.errors import GuardError, InvalidValueError, StoppedError
from hal.base.messages import ArmState, RgbdFrame, ServoMode
from hal.rig import RIGS, Devices, connect_remote, connect_rig
from z1_runtime.config import RuntimeConfig
from z1_runtime.motion.executor import Executor
from z1_runtime.motion.limits import MotionLimits
from z1_runtime.motion.trajectory import joint_move
from z1_runtime.perception.extrinsics import Extrinsics, find_extrinsics
from z1_runtime.tasks.holding import check_empty, check_release
from z1_runtime.visualization.rerun_logger import RerunLogger

if TYPE_CHECKING:  # detector, generator and planner take seconds to load, and only a pick needs them
    from hal.base.arm import ServoedArm
    from hal.base.camera import Camera
    from hal.bus.session import BusConfig
    from hal.servo.guard import Guard
    from models.types import GraspGenerator
    from z1_runtime.geometry.kinematics import Kinematics
    from z1_runtime.perception.detector import Detector
    from z1_runtime.tasks.grasp_selection import GraspSelector
    from z1_runtime.tasks.pick import Phase, PickResult


class Robot:
    """An arm with a wrist camera; use it in a `with` block, or call `close`.

    Args:
        devices: of `hal.rig`; entered here and left by `close`.
        config: settings; None = the defaults.
        extrinsics: camera pose on the flange; None = looked up by the serial number of the first frame.
        calibration: hand-eye result for that look-up; None = the newest of this camera, else the mount's drawing.
        selector: detector, generator and planner, loaded already; None = loaded by `warm_up` or the first pick.
        detector: object used in place of the configured detector.
        generator: object used in place of the configured grasp generator.
        recording: .rrd file of the run.
        view: show the run live in Rerun.
        owner: name of this process as the owner of the command lease.
        on_phase: called with each finished phase of a pick.
    """

    def __init__(
        self,
        devices: AbstractContextManager[Devices],
        *,
        config: RuntimeConfig | None = None,
        extrinsics: Extrinsics | None = None,
        calibration: Path | None = None,
        selector: GraspSelector | None = None,
        detector: Detector | None = None,
        generator: GraspGenerator | None = None,
        recording: Path | None = None,
        view: bool = False,
        owner: str = "runtime",
        on_phase: Callable[[Phase], None] = lambda _: None,
    ) -> None:
        self.config = config or RuntimeConfig()
        self._calibration = calibration
        self._selector, self._detector, self._generator = selector, detector, generator
        self._owner, self._on_phase = owner, on_phase
        self._live_view = False
        if extrinsics is not None:
            self.extrinsics = extrinsics
        with ExitStack() as stack:
            self.logger = RerunLogger(recording, live=view)
            stack.callback(self.logger.close)
            self.devices = stack.enter_context(devices)
            self._stack = stack.pop_all()
        self._executor = Executor(self.arm, self.clock, self.config.executor)
        self._executor.watchers.append(self.logger.log_arm)

    @classmethod
    def simulate(
        cls,
        object: str = "bottle",
        *,
        distance_m: float = 0.48,
        lateral_m: float = 0.0,
        pitch_deg: float = 0.0,
        seed: int = 0,
        lockstep: bool = True,
        config: RuntimeConfig | None = None,
        calibration: Path | None = None,
        **options: Any,
    ) -> Self:
        """Return a digital twin in this process.

        Args:
            object: name of the object on the table.
            distance_m: of the object in front of the base [m].
            lateral_m: of the object to the left [m].
            pitch_deg: lean of the object about the base's y axis [°].
            seed: of the camera's noise and of the grasp generator.
            lockstep: use the twin's own clock, so that the same seed gives the same result; False = the wall clock.
            config: see the class.
            calibration: see the class.
            **options: the other arguments of the class.

        Raises:
            InvalidValueError: the scene is out of range.
        """
        scene = {"object": object, "distance_m": distance_m, "lateral_m": lateral_m, "pitch_deg": pitch_deg}
        rig = RIGS.make("sim", lockstep=lockstep, seed=seed, **scene)
        return cls(
            connect_rig(rig),
            config=replace(config or RuntimeConfig(), seed=seed),
            extrinsics=find_extrinsics(rig.world.config.camera_serial(), calibration),
            **options,
        )

    @classmethod
    def connect(
        cls, bus: BusConfig | None = None, *, owner: str = "runtime", camera: bool = True, **options: Any
    ) -> Self:
        """Return the robot of a running HAL process (`./z1 hal`), on this machine or another.

        Args:
            bus: address of the HAL process.
            owner: see the class.
            camera: False for the arm alone, which moves and cannot pick.
            **options: the other arguments of the class.

        Raises:
            HalTimeoutError: no HAL process answers.
        """
        from hal.bus.session import BusConfig

        return cls(connect_remote(bus or BusConfig(), owner, camera=camera), owner=owner, **options)

    @property
    def arm(self) -> ServoedArm:
        """The servoed arm."""
        return self.devices.arm

    @property
    def camera(self) -> Camera:
        """The wrist camera."""
        return self.devices.camera

    @property
    def clock(self) -> Clock:
        """The clock of arm and camera."""
        return self.devices.clock

    @cached_property
    def extrinsics(self) -> Extrinsics:
        """Camera pose on the flange, and its origin."""
        return find_extrinsics(self.frame().serial, self._calibration)

    # --- Measurements ---------------------------------------------------------------------------------------------

    def frame(self) -> RgbdFrame:
        """Return the camera's next frame.

        Raises:
            HalTimeoutError: none arrives within the configured `frame_timeout_s`.
        """
        return self.camera.wait_for_frame(self.config.frame_timeout_s)

    def state(self) -> ArmState:
        """Return the arm's newest measurement.

        Raises:
            HalTimeoutError: the newest measurement is too old.
        """
        return self.arm.read_state()

    # --- Motion ---------------------------------------------------------------------------------------------------

    def move_to(self, goal: np.ndarray, *, jaw: float | None = None, drop: bool = False) -> ArmState:
        """Move straight in joint space to `goal`; return the state at rest there.

        Args:
            goal: arm joints (6,) or all joints (7,) [rad], or a pose T_base_pivot (4, 4) of the gripper's pivot.
            jaw: jaw angle at the goal [rad]; None = as `goal` has it, else unchanged.
            drop: open the jaws also when they hold an object.

        Raises:
            GripperLoadedError: the jaws hold an object, the goal is more open, and `drop` is False; nothing moves.
            InvalidValueError: `goal` is outside the joint limits or of another shape; nothing moves.
            IkFailure: no joints inside the limits reach the pose; nothing moves.
            GuardError: the motion meets table, arm or the workspace's border; nothing moves.
            CommandRejectedError: the servo rejects the motion, as after a stop or without the lease.
            MotionError: the motion began and was not finished.
        """
        self.arm.claim(self._owner)
        q_start = np.clip(self.arm.status().q_command, z1.Q_MIN, z1.Q_MAX)
        q_goal = self._goal_joints(goal, q_start, jaw)
        if not drop:
            check_release(self.state(), float(q_start[z1.N_ARM]), float(q_goal[z1.N_ARM]), self.config, "move")
        motion = joint_move(q_start, q_goal, MotionLimits.at_speed(self.config.speed))
        if violation := self._guard.find_violation(motion.q, q_start):
            raise GuardError(
                f"robot: the motion is not allowed ({100 * violation.index / len(motion.q):.0f} % along it, "
                f"{violation.text}). Choose another goal, or go there by way of another posture.",
                code=violation.code,
            )
        self._executor.execute(motion)
        return self._executor.settle()

    def home(self, *, jaw: float | None = None, drop: bool = False) -> ArmState:
        """Move to the observation posture (see `move_to`); without `jaw` a held object stays held."""
        return self.move_to(z1.Q_HOME, jaw=jaw, drop=drop)

    def stop(self) -> None:
        """Brake, hold, and latch; every command is rejected until `rearm`."""
        self.arm.stop()

    def rearm(self) -> None:
        """Lift a latched stop, after the operator has inspected the arm; it holds its position."""
        self.arm.rearm()

    # --- Picking --------------------------------------------------------------------------------------------------

    def warm_up(self) -> None:
        """Load detector, generator and planner, and run them once, so that the first pick does not wait for them."""
        self._load_selector(self.config)

    def check_ready(self, *, drop: bool = False) -> None:
        """Check that a pick may begin, before anything slow is loaded for it.

        Args:
            drop: allow jaws that hold an object.

        Raises:
            StoppedError: the stop is latched.
            GripperLoadedError: the jaws hold an object and `drop` is False.
        """
        status = self.arm.status()
        if status.mode is ServoMode.STOPPED:
            raise StoppedError(status.reason)
        if not drop:
            check_empty(self.state(), self.config, "pick")

    def pick(self, object_class: str | None = None, *, attempts: int | None = None, drop: bool = False) -> PickResult:
        """Pick an object from the home posture, and hold it up.

        Args:
            object_class: class of the object, for a detector that knows classes; None = the configuration's.
            attempts: number of picks until the jaws hold an object; None = the configuration's.
            drop: open the jaws also when they hold an object at the start.

        Raises:
            StoppedError, GripperLoadedError: see `check_ready`; nothing moves.
            InvalidValueError: the detector does not know the class.
            PerceptionError: no usable object is visible.
            NoPlanError: no candidate is feasible.
            MotionError, HalError: the arm does not follow.
        """
        from z1_runtime.tasks.pick import PickTask

        self.check_ready(drop=drop)
        config = replace(
            self.config,
            object_class=self.config.object_class if object_class is None else object_class,
            attempts=self.config.attempts if attempts is None else attempts,
        )
        selector = self._load_selector(config)
        self.arm.claim(self._owner)
        task = PickTask(
            selector=selector,
            arm=self.arm,
            camera=self.camera,
            clock=self.clock,
            logger=self.logger,
            config=config,
            on_phase=self._on_phase,
        )
        return task.pick_until_held(drop=drop)

    # --- Life -----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Release the lease, disconnect the devices, and finish the recording. Harmless when closed."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- Inside ---------------------------------------------------------------------------------------------------

    @cached_property
    def _guard(self) -> Guard:
        from hal.servo.guard import Guard

        return Guard()

    @cached_property
    def _kinematics(self) -> Kinematics:
        from z1_runtime.geometry.kinematics import Kinematics

        return Kinematics()

    def _goal_joints(self, goal: np.ndarray, q_start: np.ndarray, jaw: float | None) -> np.ndarray:
        """Return the joints (7,) that `goal` and `jaw` mean [rad]."""
        goal = np.asarray(goal, dtype=np.float64)
        if goal.shape == (4, 4):
            goal = self._kinematics.best(goal, q_start[: z1.N_ARM]).q
        if goal.shape not in ((z1.N_ARM,), (z1.N_JOINTS,)):
            raise InvalidValueError(
                f"robot: the goal has no usable shape ({goal.shape}, allowed (6,), (7,) or (4, 4)). "
                "Give joints or a pose of the pivot."
            )
        q_jaw = q_start[z1.N_ARM :] if len(goal) == z1.N_ARM else goal[z1.N_ARM :]
        return np.append(goal[: z1.N_ARM], q_jaw if jaw is None else jaw)

    def _load_selector(self, config: RuntimeConfig) -> GraspSelector:
        """Return the selector for `config`, which differs from `self.config` in class and attempts only."""
        from z1_runtime.factory import check_object_class, make_grasp_selector, warm_up_selector

        if self._selector is None:
            self._selector = make_grasp_selector(
                config, self.extrinsics.T_flange_camera, detector=self._detector, generator=self._generator
            )
            warm_up_selector(self._selector)
        elif self._selector.config != config:
            check_object_class(config, self._selector.perception.detector)
            self._selector.config = config
        self._start_live_view()
        return self._selector

    def _start_live_view(self) -> None:
        # In lock-step a thread that waits for frames would move the time.
        if self.logger.active and self.devices.real_time and not self._live_view:
            from z1_runtime.visualization.live_view import LiveView

            view = LiveView(self.camera, self.arm, self.logger, self.extrinsics.T_flange_camera)
            self._stack.enter_context(view)
            self._live_view = True

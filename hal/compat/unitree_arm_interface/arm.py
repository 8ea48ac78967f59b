"""The vendor's `ArmInterface` on top of our driver: same names and call order, with limits that it lacks."""

from __future__ import annotations

import atexit
import logging
from collections.abc import Callable
from dataclasses import replace
from threading import Event, Thread

import numpy as np

from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.base import z1
from hal.base.clock import Clock, WallClock
from hal.base.errors import CommandRejectedError, HalError
from hal.base.messages import ArmSetpoint
from hal.compat.unitree_arm_interface.lowlevel import CtrlComponents, RecvState, UDPPort
from hal.compat.unitree_arm_interface.model import ArrayLike, Z1Model, postureToHomo
from hal.z1_protocol.controller import TrajectoryCommand
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import MOVES, Fsm

log = logging.getLogger(__name__)

_LOG_PERIOD_S = 1.0  # of repeated errors of the loop
_CARTESIAN_TIMEOUT_S = 0.5  # a script that ends must not leave the arm moving
_GRIPPER_SPEED = 1.0
_MAX_ORIENTATION_SPEED, _MAX_POSITION_SPEED = 0.6, 0.3  # [rad/s], [m/s]
_MAX_LINEAR_SPEED = 1.0  # [m/s]; above it the vendor's MoveL gets no faster (measured)


class ArmInterface:
    """A Z1 with the interface of the vendor's Python module.

    Differences, for safety: every command is within the limits of position, speed and torque; CARTESIAN tracking is
    computed here and sent as joint positions, and ends 0.5 s after the last `cartesianCtrlCmd`; an unreachable state
    is an error in the log and `False`, not an endless wait; `labelRun` and `backToStart` pass through JOINTCTRL where
    necessary.

    Args:
        hasGripper: whether the model has the gripper's mass.
    """

    make_arm: Callable[[Z1ArmConfig], Z1Arm] = staticmethod(lambda config: Z1Arm(WallClock(), config))
    """Factory of the driver; replaceable, for a test or another clock."""
    udp = UDPPort()
    """Address of the controller of a new interface."""

    def __init__(self, hasGripper: bool = True) -> None:
        model = Z1Model.with_gripper() if hasGripper else Z1Model()
        self._ctrlComp = CtrlComponents(model, self.udp, RecvState(self.getCurrentState))
        self.lowstate = self._ctrlComp.lowstate
        self.lowcmd = self._ctrlComp.lowcmd
        self.q, self.qd, self.tau = np.zeros(z1.N_ARM), np.zeros(z1.N_ARM), np.zeros(z1.N_ARM)
        self.gripperQ = self.gripperQd = self.gripperTau = 0.0
        self._made: Z1Arm | None = None
        self._thread: Thread | None = None
        self._end = Event()
        self._wait = True
        self._track: Fsm | None = None
        self._rates = np.zeros(6)
        self._rates_until_s = 0.0
        self._logged_s = -np.inf

    # --- Communication ----------------------------------------------------------------------------------------------

    @property
    def _arm(self) -> Z1Arm:
        """The driver, connected at its first use, so that `udp` can be set before.

        Raises:
            HalError: no answer, or another program uses the port.
        """
        if self._made is None:
            udp: UDPPort = self._ctrlComp.udp
            made = self.make_arm(replace(udp.config, mode=Z1Mode.OBSERVE))
            made.connect()
            self._made = made
            self.lowstate.update(made.newest)
            atexit.register(self._close)  # the vendor's interface has no call that disconnects
        return self._made

    def _close(self) -> None:
        self.loopOff()
        if self._made is not None:
            self._made.disconnect()
            self._made = None
        atexit.unregister(self._close)

    def loopOn(self) -> None:
        """Start sending and receiving at 500 Hz in the background."""
        if self._thread is None:
            clock = self._arm.clock
            self._end.clear()
            self._thread = Thread(target=self._run, args=(clock,), name="Z1Communication", daemon=True)
            self._thread.start()

    def loopOff(self) -> None:
        """End the loop of `loopOn`; the arm holds."""
        if self._thread is not None:
            self._end.set()
            self._thread.join()
            self._thread = None
            self._arm.idle()

    def _run(self, clock: Clock) -> None:
        deadline_s = clock.now_s()
        while not self._end.is_set():
            try:
                self.sendRecv()
            except (HalError, ValueError) as error:
                if clock.now_s() - self._logged_s > _LOG_PERIOD_S:
                    self._logged_s = clock.now_s()
                    log.error("%s", error)
            deadline_s = max(deadline_s + self._ctrlComp.dt, clock.now_s())
            clock.sleep_until(deadline_s)

    def sendRecv(self) -> None:
        """Send the command of the present state and process the answers; for a script's own loop, after `loopOff`.

        Raises:
            HalError: the controller is silent, or does not follow.
            ValueError: a command with a wrong shape or values that are not finite.
        """
        arm, mode, track = self._arm, self._arm.mode, self._track
        arm.read_state()
        self.lowstate.update(arm.newest)
        try:
            if mode is Z1Mode.LOW_LEVEL:
                arm.send_motors(self._motor_commands())
            elif track is not None and mode is Z1Mode.TRACKING:
                if track is Fsm.CARTESIAN:
                    self._follow_rates(arm)
                arm.send(ArmSetpoint(q=self._join(self.q, self.gripperQ), dq=self._join(self.qd, self.gripperQd)))
            else:
                arm.idle()
        except CommandRejectedError:
            if (
                self._track is track and arm.mode is mode and not arm.moving
            ):  # else another thread changed the mode meanwhile
                raise

    @staticmethod
    def _join(values: ArrayLike, gripper: float) -> np.ndarray:
        return np.append(np.asarray(values, dtype=float).reshape(z1.N_ARM), float(gripper))

    def _motor_commands(self) -> JointCommands:
        lowcmd = self._ctrlComp.lowcmd
        return JointCommands(
            q=self._join(self.q, self.gripperQ),
            dq=self._join(self.qd, self.gripperQd),
            tau=self._join(self.tau, self.gripperTau),
            kp=np.array(lowcmd.kp, dtype=float),
            kd=np.array(lowcmd.kd, dtype=float),
        )

    # --- States -----------------------------------------------------------------------------------------------------

    def getCurrentState(self) -> Fsm:
        """Return the controller's state; CARTESIAN while a posture is tracked."""
        state = self._arm.newest.state
        return Fsm.CARTESIAN if state is Fsm.JOINTCTRL and self._track is Fsm.CARTESIAN else state

    def setFsm(self, fsm: Fsm) -> bool:
        """Change the state and wait for it; return whether it was reached. LOWCMD follows PASSIVE only."""
        self._track = None
        arm = self._arm
        if fsm is Fsm.LOWCMD and arm.newest.state is not Fsm.PASSIVE:
            log.error("Only PASSIVE can go to LOWCMD; the controller is in %s.", arm.newest.state.name)
            return False

        def change() -> None:
            match fsm:
                case Fsm.INVALID:
                    pass
                case Fsm.PASSIVE:
                    arm.go_passive()
                case Fsm.JOINTCTRL | Fsm.CARTESIAN:
                    arm.enter(Z1Mode.TRACKING)
                    self._reset_commands()
                    self._track = Fsm.CARTESIAN if fsm is Fsm.CARTESIAN else None
                case Fsm.LOWCMD:
                    self._reset_commands()  # before entering, too: the loop sends as soon as it may
                    self._ctrlComp.lowcmd.setControlGain()
                    self._ctrlComp.lowcmd.setGripperGain()
                    arm.enter(Z1Mode.LOW_LEVEL)
                    self._reset_commands()
                case _:
                    arm.begin_move(fsm)

        return self._succeeds(change)

    def setFsmLowcmd(self) -> None:
        """Enter LOWCMD through PASSIVE and end the loop: from now on the script calls `sendRecv`.

        `q`, `qd`, `tau` and the gripper's start from the measurement.
        """
        self.loopOff()
        if self.setFsm(Fsm.PASSIVE):
            self.setFsm(Fsm.LOWCMD)

    def startTrack(self, fsm: Fsm) -> None:
        """Start to track `q` and `qd` (JOINTCTRL) or `cartesianCtrlCmd` (CARTESIAN), from where the arm is."""
        if fsm not in (Fsm.JOINTCTRL, Fsm.CARTESIAN):
            log.error("startTrack takes JOINTCTRL or CARTESIAN, not %r.", fsm)
        elif self.setFsm(fsm):
            self._track = fsm

    def setWait(self, Y_N: bool) -> None:
        """Set whether MoveJ, MoveL, MoveC, labelRun, backToStart and teachRepeat wait for their end."""
        self._wait = bool(Y_N)

    def _reset_commands(self) -> None:
        newest = self._arm.newest
        joints = newest.joints
        self.lowstate.update(newest)
        self._rates = np.zeros(6)
        self.q, self.qd, self.tau = joints.q[: z1.N_ARM].copy(), np.zeros(z1.N_ARM), np.zeros(z1.N_ARM)
        self.gripperQ, self.gripperQd, self.gripperTau = float(joints.q[z1.N_ARM]), 0.0, 0.0

    @staticmethod
    def _succeeds(action: Callable[[], object]) -> bool:
        try:
            action()
        except CommandRejectedError as error:
            log.error("%s", error)
            return False
        return True

    # --- Motions of the controller ----------------------------------------------------------------------------------

    def backToStart(self) -> bool:
        """Move to `startFlat` and close the gripper."""
        return self._move(Fsm.BACKTOSTART)

    def labelRun(self, label: str) -> bool:
        """Move to a saved label of up to ten characters."""
        return self._move(Fsm.TOSTATE, label)

    def labelSave(self, label: str) -> bool:
        """Save the present pose under a label."""
        return self._move(Fsm.SAVESTATE, label)

    def teach(self, label: str) -> bool:
        """Record a motion guided by hand under a label, until `setFsm(ArmFSMState.JOINTCTRL)`."""
        return self._move(Fsm.TEACH, label, wait=False)

    def teachRepeat(self, label: str) -> bool:
        """Replay a recording."""
        return self._move(Fsm.TEACHREPEAT, label)

    def calibration(self) -> bool:
        """Make the present pose the zero of all joints; ends in PASSIVE."""
        self._track = None
        return self._succeeds(self._arm.calibrate)

    def MoveJ(self, posture: ArrayLike, *arguments: float) -> bool:
        """Move to a posture (6,) along joint space: `MoveJ(posture, [gripperPos,] maxSpeed)` with speed in rad/s.

        Returns:
            Whether the posture is reachable, and the motion succeeded.
        """
        return self._go(Fsm.MOVEJ, [posture], arguments, float(z1.DQ_MAX[0]))

    def MoveL(self, posture: ArrayLike, *arguments: float) -> bool:
        """Move to a posture (6,) along a line: `MoveL(posture, [gripperPos,] maxSpeed)` with speed in m/s."""
        return self._go(Fsm.MOVEL, [posture], arguments, _MAX_LINEAR_SPEED)

    def MoveC(self, middlePosture: ArrayLike, endPosture: ArrayLike, *arguments: float) -> bool:
        """Move along an arc: `MoveC(middlePosture, endPosture, [gripperPos,] maxSpeed)` with speed in m/s."""
        return self._go(Fsm.MOVEC, [middlePosture, endPosture], arguments, _MAX_LINEAR_SPEED)

    def _go(self, fsm: Fsm, postures: list[ArrayLike], arguments: tuple[float, ...], max_speed: float) -> bool:
        if not 1 <= len(arguments) <= 2:
            raise TypeError(
                f"the postures are followed by [gripperPos,] maxSpeed; received {len(arguments)} arguments."
            )
        *gripper, speed = arguments
        model = self._ctrlComp.armModel
        for posture in postures:
            if not model.inverseKinematics(postureToHomo(posture), self.lowstate.getQ(), True)[0]:
                log.error("The posture %s is unreachable within the joint limits.", posture)
                return False
        poses = np.zeros((2, 6))
        poses[: len(postures)] = postures
        angle = float(gripper[0]) if gripper else self._arm.newest.joints.q[z1.N_ARM]
        move = TrajectoryCommand(
            poses=poses,
            gripper_rad=float(np.clip(angle, z1.GRIPPER_OPEN, z1.GRIPPER_CLOSED)),
            max_speed=float(np.clip(speed, 0.0, max_speed)),
        )
        return self._move(fsm, move)

    def _move(self, fsm: Fsm, body: TrajectoryCommand | str | None = None, *, wait: bool | None = None) -> bool:
        arm = self._arm
        self._track = None

        def move() -> None:
            if arm.moving and arm.newest.state in MOVES:
                arm.end_move()
            elif arm.moving or arm.mode is not Z1Mode.TRACKING:
                arm.enter(Z1Mode.TRACKING)
            arm.begin_move(fsm, body)
            if self._wait if wait is None else wait:
                arm.end_move()

        return self._succeeds(move)

    # --- Commands ---------------------------------------------------------------------------------------------------

    def jointCtrlCmd(self, directions: ArrayLike, jointSpeed: float) -> None:
        """Advance `q` and `gripperQ` by one period at `directions` (7,) of −1 … 1 times `jointSpeed` [rad/s]."""
        speed = float(np.clip(jointSpeed, 0.0, z1.DQ_MAX[0]))
        step = np.clip(np.asarray(directions, dtype=float).reshape(z1.N_JOINTS), -1.0, 1.0) * speed
        q = self._join(self.q, self.gripperQ) + step * self._ctrlComp.dt
        self._set(np.clip(q, z1.Q_MIN, z1.Q_MAX), step)

    def cartesianCtrlCmd(self, directions: ArrayLike, oriSpeed: float, posSpeed: float) -> None:
        """Change the posture at `directions` (7,) of −1 … 1 (roll, pitch, yaw, x, y, z, gripper) times `oriSpeed`
        [rad/s] up to 0.6 and `posSpeed` [m/s] up to 0.3; the gripper turns at 1 rad/s."""
        rate_ratios = np.clip(np.asarray(directions, dtype=float).reshape(z1.N_JOINTS), -1.0, 1.0)
        rates = np.repeat(
            [np.clip(oriSpeed, 0.0, _MAX_ORIENTATION_SPEED), np.clip(posSpeed, 0.0, _MAX_POSITION_SPEED)], 3
        )
        self._rates = rate_ratios[:6] * rates
        self.gripperQd = float(rate_ratios[6]) * _GRIPPER_SPEED
        self._rates_until_s = self._arm.clock.now_s() + _CARTESIAN_TIMEOUT_S

    def setArmCmd(self, q: ArrayLike, qd: ArrayLike, tau: ArrayLike | None = None) -> None:
        """Set `q` (6,) [rad], `qd` (6,) [rad/s] and `tau` (6,) [Nm]."""
        self.q, self.qd = np.array(q, dtype=float), np.array(qd, dtype=float)
        self.tau = np.zeros(z1.N_ARM) if tau is None else np.array(tau, dtype=float)

    def setGripperCmd(self, gripperPos: float, gripperW: float, gripperTau: float = 0.0) -> None:
        """Set the gripper's position [rad], speed [rad/s] and torque [Nm]."""
        self.gripperQ, self.gripperQd, self.gripperTau = float(gripperPos), float(gripperW), float(gripperTau)

    def _set(self, q: np.ndarray, dq: np.ndarray) -> None:
        self.q, self.gripperQ = q[: z1.N_ARM], float(q[z1.N_ARM])
        self.qd, self.gripperQd = dq[: z1.N_ARM], float(dq[z1.N_ARM])

    def _follow_rates(self, arm: Z1Arm) -> None:
        dt = self._ctrlComp.dt
        if arm.clock.now_s() > self._rates_until_s:
            self._rates, self.gripperQd = np.zeros(6), 0.0
        qd = self._ctrlComp.armModel.end_speeds(self._rates, self.q, dt) if self._rates.any() else np.zeros(z1.N_ARM)
        speed = np.append(qd, self.gripperQd)
        self._set(np.clip(self._join(self.q, self.gripperQ) + dt * speed, z1.Q_MIN, z1.Q_MAX), speed)

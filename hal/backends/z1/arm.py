"""Driver of the real Z1: the vendor's controller over UDP, with the limits and checks that it lacks.

That controller has no position limit while tracking, no torque limit in LOWCMD, and a watchdog of 2.2 s that ends in a
limp arm (measured). Limits are enforced here on every command, a few milliseconds of motion are handed over at a time,
so that the arm comes to rest when its client ends, and a keeper process talks to the controller while this one cannot.
"""

from __future__ import annotations

import logging
from threading import RLock

from hal.backends.z1.client import Z1Client
from hal.backends.z1.command_writer import CommandWriter
from hal.backends.z1.config import Z1ArmConfig, Z1Diagnostics, Z1Mode
from hal.backends.z1.faults import motor_values
from hal.backends.z1.keeper.owner import KeeperOwner, take_over
from hal.backends.z1.mode_machine import ModeMachine
from hal.backends.z1.motions import MOVE_TIMEOUT_S, ControllerMotions
from hal.backends.z1.requests import StateRequester
from hal.base.arm import CommandLatency
from hal.base.clock import Clock, WallClock
from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError
from hal.base.messages import ArmSetpoint, ArmState
from hal.servo.limits import ServoLimits
from hal.z1_protocol.controller import ControllerState, TrajectoryCommand
from hal.z1_protocol.link import DatagramLink, UdpLink
from hal.z1_protocol.records import JointCommands
from hal.z1_protocol.states import Fsm

log = logging.getLogger(__name__)

# Ten periods without a command or a look into the socket: its answers are outdated, and new ones have to be asked for.
_QUIET_S = 0.02
_KEEPER_START_S = 30.0


class Z1Arm:
    """A Unitree Z1 with its gripper (`hal.base.arm.Arm`).

    Every method may be called from any thread. One lock guards client, mode machine, motions and command writer: the
    methods here and `ControllerMotions` take it, the other parts expect it to be held. `stop` alone acts before it has
    the lock: it cancels the wait of the thread that holds it.

    Args:
        clock: source of time; None = wall clock.
        config: address of the controller, and the mode to use it in.
        limits: limits of every command.
        link: datagram link to the controller; None = UDP as in `config`.
    """

    def __init__(
        self,
        clock: Clock | None = None,
        config: Z1ArmConfig | None = None,
        *,
        limits: ServoLimits | None = None,
        link: DatagramLink | None = None,
    ) -> None:
        self.clock = clock or WallClock()
        self.config = config or Z1ArmConfig()
        self.limits = limits or ServoLimits()
        self._keeper: KeeperOwner | None = None
        if link is None:
            c = self.config
            link = UdpLink((c.host, c.command_port), (c.local_host, c.state_port))
            self._keeper = KeeperOwner((c.local_host, c.state_port))
        self._lock = RLock()
        self._client = Z1Client(link, self.clock)
        self._commands = CommandWriter(self._client, self.limits)
        self._requests = StateRequester(self._client)
        self._modes = ModeMachine(self._client, self._requests, self._commands, self.config.connect_timeout_s)
        self._motions = ControllerMotions(self._client, self._requests, self._modes, self._lock)
        self._found = Fsm.INVALID

    # --- Connection ---------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Connect to the controller and hold the arm where it is, in the configured mode.

        An arm that a keeper holds is taken over with its grip. From here to `disconnect` and beyond, a keeper process
        sends in place of a driver that is silent or has ended.

        Raises:
            HalTimeoutError: no answer.
            LeaseError: another program uses the port.
            CommandRejectedError: the mode cannot be entered; the arm is left as it was.
        """
        with self._lock:
            if self._modes.mode is not None:
                return
            client = self._client
            if self._keeper is not None:
                take_over((self.config.local_host, self.config.state_port))
            client.open(self.config.connect_timeout_s)
            self._found = client.newest.state
            self._commands.grip_nm = None  # torque control of an earlier connection must not persist
            try:
                self._start_keeper()
                self._modes.start(self.config.mode)
            except HalError:
                self._return_to_found_state()
                self._close()
                raise
            log.info("Z1: connected to %s, which was in %s", client.link.describe(), self._found.name)

    def disconnect(self) -> None:
        """Close the link. The keeper holds the arm from now on, unless it is in PASSIVE."""
        with self._lock:
            if self._modes.mode is None:
                return
            try:
                self._modes.leave()
            except HalError as error:
                log.warning("Z1: disconnected without an answer: %s", error)
            self._close()

    def _start_keeper(self) -> None:
        fd = self._client.link.fileno()
        if self._keeper is None or fd is None:
            return
        self._keeper.start(fd)
        self._client.publish = self._keeper.record
        # The controller must not wait for the start of a process.
        if not self._client.exchange_until(self._keeper.is_ready, _KEEPER_START_S):
            raise HalTimeoutError(
                f"Z1: the keeper's process is not ready after {_KEEPER_START_S:.0f} s. End other programs on this "
                f"machine, then connect again.",
                code="keeper_failed",
            )

    def _close(self) -> None:
        """Close the link; the keeper holds an arm that is not limp."""
        self._client.publish = None
        if self._keeper is not None:
            self._keeper.stop(hold=self._client.newest.state is not Fsm.PASSIVE)
        self._client.close()

    def give_back(self) -> None:
        """Return the arm to the state in which `connect` found it, and only observe it from now on.

        Without stiffness (PASSIVE) if it was so; from every other state it goes on holding where it is.
        """
        with self._lock:
            self._modes.require_connection()
            self._return_to_found_state()

    def _return_to_found_state(self) -> None:
        if self._found is not Fsm.PASSIVE or self._client.newest.state is Fsm.PASSIVE:
            return
        try:
            self._requests.request(Fsm.PASSIVE)
            self._modes.observe()
        except HalError as error:
            log.error("Z1: the arm was found without stiffness, and could not be returned to it: %s", error)

    # --- The contract -------------------------------------------------------------------------------------------

    def read_state(self) -> ArmState:
        with self._lock:
            client = self._modes.require_connection()
            if self.clock.now_s() - client.polled_s > _QUIET_S:
                self._modes.refresh()
            client.receive()
            if self.clock.now_s() - client.sent_s > _QUIET_S:
                self._modes.hold()
            client.check_age()
            if not self._modes.moving:
                self._commands.check_freshness()
            joints = client.newest.joints
            return ArmState(
                stamp_s=client.newest_s,
                q=joints.q,
                dq=joints.dq,
                tau=joints.tau,
                faults=client.faults.active(self.clock.now_s()),
            )

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        with self._lock:
            self._modes.require_connection().receive()
            self._modes.require_command_authority()
            applied = self._commands.write_setpoint(setpoint)
            self._commands.send()
            return applied

    def send_motors(self, commands: JointCommands) -> JointCommands:
        """Command the seven motors directly, in LOW_LEVEL; return the commands within the limits on position, speed
        and torque (`hal.backends.z1.torque_limits.limit_commands`). Nothing is compensated.

        A torque without stiffness ends when this process is silent for 0.2 s: the keeper then holds the posture.

        Raises:
            CommandRejectedError: the arm is in another mode, or does not follow.
            InvalidMessageError: values that are not finite.
        """
        with self._lock:
            self._modes.require_connection().receive()
            self._modes.require_command_authority()
            if self.mode is not Z1Mode.LOW_LEVEL:
                raise CommandRejectedError(
                    f"Z1: the arm is in mode {self.mode}; motors are commanded in low_level. Enter it first.",
                    code="wrong_mode",
                )
            applied = self._commands.write_motor_commands(commands)
            self._commands.send()
            return applied

    def stop(self) -> None:
        self._client.cancelled = True  # a thread that waits inside, with the lock, gives up
        with self._lock:
            try:
                self._modes.stop()
            except HalError as error:
                log.error("Z1: a stop was not confirmed: %s", error)

    def grip(self, torque_nm: float | None) -> None:
        """Set torque or position control of the gripper, from the next `send` on.

        Args:
            torque_nm: positive closes, negative opens, at most the limits' grip torque [Nm]; None = position control.

        Raises:
            CommandRejectedError: not a finite number, or more than the limit.
        """
        limit = self.limits.grip_torque_nm
        if torque_nm is not None and not abs(torque_nm) <= limit:
            raise CommandRejectedError(
                f"Z1: the grip torque is {torque_nm} Nm; allowed are −{limit} to {limit} Nm.", code="grip_torque"
            )
        with self._lock:
            self._commands.grip_nm = torque_nm

    # --- Modes --------------------------------------------------------------------------------------------------

    @property
    def mode(self) -> Z1Mode | None:
        """Command mode of the arm; None when it is not connected."""
        return self._modes.mode

    def enter(self, mode: Z1Mode) -> None:
        """Bring the arm into a mode, where it holds; a controller motion under way is awaited first.

        LOW_LEVEL is entered through PASSIVE, as the controller requires, with the command equal to the measurement;
        the arm is without stiffness for about two answers (5 ms). When it does not hold there, it is given back to
        JOINTCTRL.

        Raises:
            CommandRejectedError: the controller rejects the mode, or the arm does not hold still; it is only observed
                then.
            HalTimeoutError: it stopped answering.
        """
        with self._lock:
            self._modes.enter(mode)

    def go_passive(self) -> None:
        """Let the arm sink, damped, and only observe it from now on. Support it, or park it first.

        Raises:
            CommandRejectedError, HalTimeoutError: the controller does not change its state.
        """
        with self._lock:
            self._modes.require_connection()
            self._requests.request(Fsm.PASSIVE)
            self._modes.observe()

    def idle(self) -> None:
        """Process the answers and send the last command once more, at rest, which keeps the controller answering."""
        with self._lock:
            self._modes.require_connection().receive()
            self._modes.hold()

    # --- Motions of the controller ------------------------------------------------------------------------------

    @property
    def moving(self) -> bool:
        """Whether the controller executes a motion that was started here."""
        return self._modes.moving

    def begin_move(self, state: Fsm, body: TrajectoryCommand | str | None = None) -> None:
        """Start a motion of the controller (one of `hal.z1_protocol.states.MOVES`); `send` is rejected until its end.

        Raises:
            CommandRejectedError: the controller refuses it, an arc is on a line, or the arm is not in TRACKING
                (BACKTOSTART alone also leaves LOW_LEVEL).
            HalTimeoutError: the controller has not read the request, which was taken back.
        """
        self._motions.begin(state, body)

    def end_move(self, timeout_s: float = MOVE_TIMEOUT_S) -> None:
        """Wait until the motion is over, then hold where the arm is.

        Raises:
            HalTimeoutError: it is not over in time and continues, or the controller stopped answering.
            CommandRejectedError: it was stopped, or the controller ended it in another state.
        """
        self._motions.finish(timeout_s)

    def run_label(self, label: str) -> None:
        """Move to a saved pose, at the controller's own speed, and wait for it (`forward`, `startFlat`, …).

        Raises:
            CommandRejectedError: no such label.
        """
        self.begin_move(Fsm.TOSTATE, label)
        self.end_move()

    def back_to_start(self) -> None:
        """Move to `startFlat` and close the gripper, at the controller's own speed, and wait for it."""
        self.begin_move(Fsm.BACKTOSTART)
        self.end_move()

    def calibrate(self) -> None:
        """Make the present pose the zero of all joints, as the vendor's `calibration` does; ends in PASSIVE.

        Raises:
            CommandRejectedError, HalTimeoutError: the controller does not do it.
        """
        self._motions.calibrate()

    # --- Diagnostics --------------------------------------------------------------------------------------------

    @property
    def fsm(self) -> Fsm:
        """State of the controller in its newest answer.

        Raises:
            NotConnectedError: before `connect()`.
        """
        return self.newest.state

    @property
    def newest(self) -> ControllerState:
        """The newest answer, however old.

        Raises:
            NotConnectedError: before `connect()`.
        """
        return self._modes.require_connection().newest

    def diagnostics(self) -> Z1Diagnostics:
        """Return the health of arm and connection, from the newest answer.

        Raises:
            NotConnectedError: before `connect()`.
        """
        with self._lock:
            client = self._modes.require_connection()
            now_s = self.clock.now_s()
            return Z1Diagnostics(
                fsm=client.newest.state,
                pose=client.newest.pose,
                temperatures_c=motor_values(client.newest.joints.temperature_c).astype(float),
                faults=client.faults.latched(),
                answer_age_s=now_s - client.newest_s,
                unchanged_s=now_s - client.changed_s,
                latency=client.pacer.summary(),
                request=self._requests.last,
                counts=client.counts,
                invalid_reason=client.invalid_reason,
            )

    def command_latency(self) -> CommandLatency:
        """Return the time from a command to the controller's answer to it; without the lock, for any thread."""
        return self._client.pacer.summary()

    def clear_faults(self) -> None:
        """Clear the latched faults; those that persist are latched again."""
        with self._lock:
            self._client.faults.clear()

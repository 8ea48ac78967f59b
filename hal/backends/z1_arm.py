"""The real Z1: the vendor's controller over UDP, with the limits and the caution that it has not.

That controller has no watchdog (it keeps its last command for ever), no position limit while tracking and no torque
limit in LOWCMD. All three are enforced here, on every command, and never more than one control period of motion is
handed over: whoever dies leaves an arm that holds.
"""

from __future__ import annotations

import logging
from threading import RLock

import numpy as np

from hal import z1
from hal.backends.z1_client import Z1Client
from hal.backends.z1_commands import Z1Commands
from hal.backends.z1_config import Z1ArmConfig, Z1Diagnostics, Z1Mode
from hal.backends.z1_faults import motor_values
from hal.clock import Clock, WallClock
from hal.errors import CommandRefusedError, HalError, HalTimeoutError, NotConnectedError
from hal.limits import ServoLimits
from hal.messages import ArmSetpoint, ArmState
from hal.wire.controller import ControllerState, TrajectoryCommand
from hal.wire.link import Link, UdpLink
from hal.wire.records import JointCommands
from hal.wire.states import MOVES, Fsm

log = logging.getLogger(__name__)

_SETTLE_S = 0.1
_SETTLE_RAD = 0.05
_REST_SPEED = 0.05
_REST_WAIT_S = 0.2
_ENTRY_S = 0.05
_QUIET_S = 0.005
_IDLE_WAIT_S = 0.02
_IDLE_TRIES = 5
_MOVE_TIMEOUT_S = 60.0


_FSM = {
    Z1Mode.OBSERVE: None,
    Z1Mode.TRACKING: Fsm.JOINTCTRL,
    Z1Mode.LOW_LEVEL: Fsm.LOWCMD,
}


class Z1Arm:
    """A Unitree Z1 with its gripper (`hal.arm.Arm`); any thread may call anything.

    Args:
        clock: by which it lives; None = the wall's.
        config: where the controller is and how to use it.
        limits: what every command is clipped to.
        link: the way to the controller; None = UDP as in `config`.
    """

    def __init__(
        self,
        clock: Clock | None = None,
        config: Z1ArmConfig | None = None,
        *,
        limits: ServoLimits | None = None,
        link: Link | None = None,
    ) -> None:
        self.clock = clock or WallClock()
        self.config = config or Z1ArmConfig()
        self.limits = limits or ServoLimits()
        if link is None:
            c = self.config
            link = UdpLink((c.host, c.command_port), (c.local_host, c.state_port))
        self._client = Z1Client(link, self.clock)
        self._commands = Z1Commands(self._client, self.limits)
        self._lock = RLock()
        self._mode: Z1Mode | None = None
        self._moving = False

    # --- Life -------------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Find the controller and hold the arm where it is, in the configured mode.

        Raises:
            HalTimeoutError: nobody answers.
            LeaseError: another program talks to it already.
            CommandRefusedError: it does not go into the mode; the arm is left as it was found.
        """
        with self._lock:
            if self._mode is not None:
                return
            client = self._client
            client.open(self.config.connect_timeout_s)
            found = client.newest.state
            self._commands.grip_nm = None
            self._mode, self._moving = Z1Mode.OBSERVE, False
            try:
                if found is Fsm.LOWCMD:  # left there by somebody: every datagram commands its motors
                    client.ask(Fsm.JOINTCTRL)
                self.enter(self.config.mode)
            except HalError:
                self._mode = None
                client.close()
                raise
            log.info("Z1: connected to %s, which was in %s", client.link.describe(), found.name)

    def disconnect(self) -> None:
        with self._lock:
            if self._mode is None:
                return
            try:
                if self._mode is Z1Mode.LOW_LEVEL:
                    self._client.ask(Fsm.JOINTCTRL)
                elif self._mode is Z1Mode.TRACKING:
                    self.stop()
            except HalError as error:
                log.warning("Z1: let go of without an answer: %s", error)
            self._mode = None
            self._client.close()

    @property
    def mode(self) -> Z1Mode | None:
        """How the arm is commanded; None when it is not connected."""
        return self._mode

    @property
    def fsm(self) -> Fsm:
        """What the controller was doing when it answered last.

        Raises:
            NotConnectedError: before `connect()`.
        """
        return self._connected().newest.state

    # --- The contract -----------------------------------------------------------------------------------------------

    def read_state(self) -> ArmState:
        with self._lock:
            client = self._connected()
            if self.clock.now_s() - client.sent_s > _QUIET_S:
                self._ask_again(client)
            client.receive()
            client.check_answers()
            if not self._moving:
                self._commands.check_measurements()
            joints = client.newest.joints
            return ArmState(
                stamp_s=client.newest_s,
                q=joints.q,
                dq=joints.dq,
                tau=joints.tau,
                faults=client.faults.shown(self.clock.now_s()),
            )

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        with self._lock:
            self._connected().receive()
            client = self._ready()
            applied = self._commands.follow(setpoint)
            client.send()
            return applied

    def send_motors(self, commands: JointCommands) -> JointCommands:
        """Command the seven motors directly, in LOW_LEVEL; return what is left after the limits on position, speed
        and torque (`hal.backends.z1_torque.limit_commands`). Nothing is compensated.

        A torque without stiffness goes on for ever when this process dies: the controller repeats its last command.

        Raises:
            CommandRefusedError: the arm is in another mode, or does not follow.
            InvalidMessageError: values that are not finite.
        """
        with self._lock:
            self._connected().receive()
            client = self._ready()
            if self._mode is not Z1Mode.LOW_LEVEL:
                raise CommandRefusedError(f"the arm is in mode {self._mode}; motors are commanded in low_level.")
            applied = self._commands.follow_motors(commands)
            client.send()
            return applied

    def idle(self) -> None:
        """Take what came and send the last command once more, at rest: what keeps the controller answering."""
        with self._lock:
            self._connected().receive()
            self._hold()

    @property
    def moving(self) -> bool:
        """Whether the controller is making a motion that was begun here."""
        return self._moving

    @property
    def newest(self) -> ControllerState:
        """The newest answer, however old.

        Raises:
            NotConnectedError: before `connect()`.
        """
        return self._connected().newest

    def stop(self) -> None:
        self._client.cancelled = True  # whoever waits inside, with the lock, gives up
        with self._lock:
            self._client.cancelled = False
            if self._mode is None:
                return
            if self._moving:
                self._moving = False
                try:
                    self._client.ask(Fsm.JOINTCTRL)
                except HalError as error:
                    log.error("Z1: a stop was not confirmed: %s", error)
                self._resume()
            self._hold()

    # --- Modes ------------------------------------------------------------------------------------------------------

    def enter(self, mode: Z1Mode) -> None:
        """Bring the arm into a mode, where it holds; a moving arm, or one in another's hands, is left alone.

        LOW_LEVEL is entered through PASSIVE, as the controller wants it, with the command equal to the measurement;
        on the way the arm is without stiffness for about two answers (5 ms). When it does not hold there, it is
        given back to JOINTCTRL.

        Raises:
            CommandRefusedError: the controller does not go there, or the arm does not hold still; it is only observed
                then.
            HalTimeoutError: it stopped answering.
        """
        with self._lock:
            client = self._connected()
            if client.newest.state in MOVES:
                client.wait_for(Fsm.JOINTCTRL, self.config.connect_timeout_s)
            self._moving = False
            self._mode = self._commands.mode = Z1Mode.OBSERVE
            if mode is Z1Mode.LOW_LEVEL:
                self._enter_low_level(client)
            elif mode is Z1Mode.TRACKING and client.newest.state is not Fsm.JOINTCTRL:
                client.ask(Fsm.JOINTCTRL)
            self._mode = mode
            self._resume()
            if mode is not Z1Mode.OBSERVE:
                self._settle(client)

    def go_passive(self) -> None:
        """Let the arm sink, damped, and only observe it from now on. Support it, or park it first.

        Raises:
            CommandRefusedError, HalTimeoutError: the controller does not.
        """
        with self._lock:
            self._connected().ask(Fsm.PASSIVE)
            self._mode = self._commands.mode = Z1Mode.OBSERVE

    def _enter_low_level(self, client: Z1Client) -> None:
        def speed() -> float:
            return float(np.abs(client.newest.joints.dq[: z1.N_ARM]).max())

        if speed() > _REST_SPEED and client.newest.state is Fsm.PASSIVE:
            client.ask(Fsm.JOINTCTRL)  # it sinks: catch it first
        if speed() > _REST_SPEED and not client.exchange_until(lambda: speed() <= _REST_SPEED, _REST_WAIT_S):
            raise CommandRefusedError(
                f"the arm moves at {speed():.2f} rad/s; low-level mode is entered at rest (below {_REST_SPEED} rad/s)."
            )
        was = client.newest.state
        if was is Fsm.LOWCMD:
            return
        try:
            client.ask(Fsm.PASSIVE, timeout_s=_ENTRY_S)
            client.ask(Fsm.LOWCMD, self._commands.entry(), timeout_s=_ENTRY_S)
        except HalError:
            self._commands.mode = Z1Mode.OBSERVE
            if was is not Fsm.PASSIVE:
                client.cancelled = False  # a stop, too, wants an arm that does not sink
                client.ask(Fsm.JOINTCTRL)
            raise

    def _resume(self) -> None:
        """Take over where the arm is."""
        mode = self._mode or Z1Mode.OBSERVE
        self._moving = False
        self._client.expected = _FSM[mode]
        self._commands.take_over(mode)
        self._hold()

    def _settle(self, client: Z1Client) -> None:
        held = self._commands.q_sent
        end_s = self.clock.now_s() + _SETTLE_S
        while self.clock.now_s() < end_s:
            self._hold()
            self.clock.sleep_until(client.sent_s + z1.CONTROL_PERIOD_S)
            client.receive()
        client.check_answers()
        off = np.abs(client.newest.joints.q - held)[: z1.N_ARM]
        if off.max() <= _SETTLE_RAD:
            return
        worst = int(off.argmax())
        if client.newest.state is Fsm.LOWCMD:
            client.ask(Fsm.JOINTCTRL)
        self._mode = self._commands.mode = Z1Mode.OBSERVE
        client.expected = None
        raise CommandRefusedError(
            f"{z1.JOINT_NAMES[worst]} moved by {off[worst]:.3f} rad while it should hold (allowed {_SETTLE_RAD}): it "
            f"is loaded beyond the model, or its zero is off. It was given back to the controller; look at it."
        )

    # --- The gripper ------------------------------------------------------------------------------------------------

    def grip(self, torque_nm: float | None) -> None:
        """Let the gripper push with a torque instead of going to a position, from the next `send` on.

        Args:
            torque_nm: positive closes, negative opens, at most the limits' grip torque [Nm]; None = by position again.

        Raises:
            CommandRefusedError: not a finite number, or more than the limit.
        """
        limit = self.limits.grip_torque_nm
        if torque_nm is not None and not abs(torque_nm) <= limit:
            raise CommandRefusedError(f"a grip torque of {torque_nm} Nm was asked; allowed are −{limit} to {limit} Nm.")
        with self._lock:
            self._commands.grip_nm = torque_nm

    # --- Motions of the controller's own ----------------------------------------------------------------------------

    def begin_move(self, state: Fsm, body: TrajectoryCommand | str | None = None) -> None:
        """Start a motion that the controller makes by itself (one of `hal.wire.states.MOVES`); `send` is refused
        until it is over.

        Raises:
            CommandRefusedError: the controller does not, or the arm is not in TRACKING.
        """
        with self._lock:
            client = self._ready()
            if self._mode is not Z1Mode.TRACKING:
                raise CommandRefusedError(f"the arm is in mode {self._mode}; its own motions start from tracking.")
            self._moving = True
            try:
                client.ask(state, body)
            except HalError:
                self._resume()
                raise

    def end_move(self, timeout_s: float = _MOVE_TIMEOUT_S) -> None:
        """Wait until the motion is over, then hold where the arm is.

        Raises:
            HalTimeoutError: it is not over in time and goes on, or the controller stopped answering.
            CommandRefusedError: it was stopped, or the controller went elsewhere.
        """
        end_s = self.clock.now_s() + timeout_s
        if not self._moving:
            return
        while True:
            with self._lock:  # not for longer: others may want to read, or to stop
                client = self._connected()
                client.receive()
                client.check_answers()
                state = client.newest.state
                if not self._moving:
                    raise CommandRefusedError("the motion was stopped before its end.")
                if state not in MOVES:
                    self._resume()
                    if state is Fsm.JOINTCTRL:
                        return
                    raise CommandRefusedError(
                        f"the motion ended in {state.name} instead of JOINTCTRL; look at the arm."
                    )
                client.send()
            if self.clock.now_s() > end_s:
                raise HalTimeoutError(f"the controller is still in {state.name} after {timeout_s} s; it goes on.")
            self.clock.sleep_until(self.clock.now_s() + z1.CONTROL_PERIOD_S)

    def run_label(self, label: str) -> None:
        """Move to a saved pose, at the controller's own speed, and wait for it (`forward`, `startFlat`, …).

        Raises:
            CommandRefusedError: no such label.
        """
        self.begin_move(Fsm.TOSTATE, label)
        self.end_move()

    def back_to_start(self) -> None:
        """Move to `startFlat`, at the controller's own speed, and wait for it."""
        self.begin_move(Fsm.BACKTOSTART)
        self.end_move()

    def calibrate(self) -> None:
        """Make the present pose the zero of all joints, as the vendor's `calibration` does; ends in PASSIVE.

        Raises:
            CommandRefusedError, HalTimeoutError: the controller does not.
        """
        self.go_passive()
        with self._lock:
            self._client.ask(Fsm.CALIBRATION)
            self._client.wait_for(Fsm.PASSIVE, _MOVE_TIMEOUT_S)

    # --- Account ----------------------------------------------------------------------------------------------------

    def diagnostics(self) -> Z1Diagnostics:
        """Return how arm and conversation are doing, from the newest answer.

        Raises:
            NotConnectedError: before `connect()`.
        """
        with self._lock:
            client = self._connected()
            now_s = self.clock.now_s()
            return Z1Diagnostics(
                fsm=client.newest.state,
                pose=client.newest.pose,
                temperatures_c=motor_values(client.newest.joints.temperature_c).astype(float),
                faults=client.faults.latched(),
                answer_age_s=now_s - client.newest_s,
                unchanged_s=now_s - client.changed_s,
                counts=client.counts,
                last_refusal=client.last_refusal,
            )

    def clear_faults(self) -> None:
        """Forget the faults seen so far; what is still there is seen again."""
        with self._lock:
            self._client.faults.clear()

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _connected(self) -> Z1Client:
        if self._mode is None:
            raise NotConnectedError("the Z1")
        return self._client

    def _ready(self) -> Z1Client:
        client = self._connected()
        if self._moving:
            raise CommandRefusedError("the controller is making a motion of its own; stop it, or wait for its end.")
        if client.expected is None:
            raise CommandRefusedError("the arm is only observed; enter another mode first.")
        if client.has_left:
            raise CommandRefusedError(
                f"the controller is in {client.newest.state.name} instead of {client.expected.name} and does not "
                f"follow. Somebody changed it, or it was restarted: look at the arm, then connect again."
            )
        return client

    def _ask_again(self, client: Z1Client) -> None:
        """Get an answer of now: nobody has been sending, and what still waits in the socket may be of any age."""
        client.discard()
        for _ in range(_IDLE_TRIES):
            self._hold()
            if client.receive(_IDLE_WAIT_S):
                return

    def _hold(self) -> None:
        """Send once more what was sent last, at rest."""
        if not self._moving:
            self._commands.hold()
        self._client.send()

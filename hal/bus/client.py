"""The runtime's end of the link: the HAL process's arm and camera, as if they were in this process."""

from __future__ import annotations

import atexit
import logging
import threading
import uuid
from types import TracebackType
from typing import Self

import zenoh

from hal.base.clock import Clock, WallClock
from hal.base.errors import HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, ArmState, ServoStatus, TrajectoryChunk
from hal.bus import keys
from hal.bus.codec import decode, encode
from hal.bus.link import BusLink
from hal.bus.remote_camera import RemoteCamera as RemoteCamera  # noqa: PLC0414 (a re-export)
from hal.bus.service import Listener, as_bytes
from hal.bus.session import BusConfig

_LOG = logging.getLogger(__name__)


class RemoteArm:
    """The servoed arm of a HAL process (`hal.base.arm.ServoedArm`).

    While it holds the lease it sends the heartbeat from a thread of its own: should this process die, or hold the
    interpreter for longer than 0.15 s in one piece, the servo brakes.

    Args:
        config: where the HAL process is.
        owner: what this process is called; a random part is added, so that two of the same name stay two.
        clock: the wall's.
    """

    def __init__(self, config: BusConfig | None = None, owner: str = "runtime", clock: Clock | None = None) -> None:
        self._config = config or BusConfig()
        self._suffix = uuid.uuid4().hex[:8]
        self._owner = f"{owner}-{self._suffix}"
        self._clock = clock or WallClock()
        self._link: BusLink | None = None
        self._states: Listener | None = None
        self._newest = b""
        self._arrived = threading.Event()
        self._heartbeat: _HeartbeatSender | None = None

    # --- Life -----------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the link and wait for the arm's first state. Harmless when open.

        Raises:
            HalTimeoutError: no HAL process answers, or it publishes no state.
        """
        if self._link is not None:
            return
        link = BusLink(self._config, self._clock, "the remote arm")
        self._arrived.clear()
        states = Listener(link.session, keys.STATE, self._on_state)
        if not self._arrived.wait(self._config.connect_timeout_s):
            states.close()
            link.close()
            raise HalTimeoutError(
                f"the HAL process at {self._config.endpoint} publishes no arm state; look at its log, then at the arm."
            )
        self._link, self._states = link, states
        atexit.register(self.disconnect)  # a program that ends carelessly leaves no thread inside Zenoh

    def disconnect(self) -> None:
        """Give the lease back, if it is ours, and close the link. Harmless when not connected."""
        link, states = self._link, self._states
        if link is None or states is None:
            return
        atexit.unregister(self.disconnect)
        try:
            if self._heartbeat is not None:
                self.release()
        except HalTimeoutError:
            pass  # there is nobody left to give it back to, and without our heartbeat it lapses
        finally:
            self._stop_heartbeat()
            self._link = self._states = None
            states.close()
            link.close()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()

    # --- Arm ------------------------------------------------------------------------------------------------------

    def read_state(self) -> ArmState:
        """Return the newest published measurement (about 10 ms old; see `hal.base.arm.Arm.read_state`)."""
        state, age_s = self._newest_state()
        if age_s > self._config.state_max_age_s:
            # Whoever kept this process from running kept the listener from it, too: what is there may wait unheard.
            self._arrived.clear()
            self._arrived.wait(self._config.state_max_age_s)
            state, age_s = self._newest_state()
        if age_s > self._config.state_max_age_s:
            raise HalTimeoutError(
                f"the newest arm state from {self._config.endpoint} is {age_s:.2f} s old; allowed is "
                f"{self._config.state_max_age_s} s. The HAL process is gone or its arm is silent: look at its log."
            )
        return state

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Hand over one setpoint (see `hal.base.arm.Arm.send`)."""
        return decode(self._connected().ask(keys.SEND, encode(setpoint), self._owner_name()), ArmSetpoint)

    def stop(self, reason: str = "") -> None:
        """Brake, hold, and latch, whoever holds the lease; returns when the servo has taken it.

        Raises:
            HalTimeoutError: no answer: use the switch on the arm.
        """
        self._connected().ask(keys.STOP, reason.encode(), self._owner_name())

    # --- Servo ----------------------------------------------------------------------------------------------------

    def claim(self, owner: str = "") -> None:
        """Take the command lease (see `hal.base.arm.ServoedArm.claim`) and begin the heartbeat.

        Args:
            owner: a name to show others; default is the one given at the start.
        """
        link = self._connected()
        name = f"{owner}-{self._suffix}" if owner else self._owner
        link.ask(keys.CLAIM, owner=name)
        if self._heartbeat is None or self._heartbeat.owner != name:
            self._stop_heartbeat()
            self._heartbeat = _HeartbeatSender(link.session, name, 1.0 / self._config.heartbeat_rate_hz)

    def release(self) -> None:
        """Give the lease back (see `hal.base.arm.ServoedArm.release`)."""
        link = self._connected()
        name = self._owner_name()
        try:
            link.ask(keys.RELEASE, owner=name)
        finally:
            self._stop_heartbeat()

    def stream(self, chunk: TrajectoryChunk) -> None:
        """Queue a piece of a trajectory; returns when the servo has taken it (see `hal.base.arm.ServoedArm.stream`)."""
        self._connected().ask(keys.CHUNK, encode(chunk), self._owner_name())

    def status(self) -> ServoStatus:
        """Ask the servo for its account of itself.

        Asked, not remembered: after `stream()` a published one may still tell of the trajectory before.
        """
        return decode(self._connected().ask(keys.READ_STATUS), ServoStatus)

    def rearm(self) -> None:
        """Lift a latched stop (see `hal.base.arm.ServoedArm.rearm`)."""
        self._connected().ask(keys.REARM, owner=self._owner_name())
        self._stop_heartbeat()

    # --- Inside ---------------------------------------------------------------------------------------------------

    def _newest_state(self) -> tuple[ArmState, float]:
        """Return the newest measurement heard, and its age [s]."""
        link = self._connected()
        state = decode(self._newest, ArmState)
        return state, self._clock.now_s() + link.clock_offset_s - state.stamp_s

    def _connected(self) -> BusLink:
        if self._link is None:
            raise NotConnectedError("the remote arm")
        return self._link

    def _owner_name(self) -> str:
        return self._heartbeat.owner if self._heartbeat is not None else self._owner

    def _on_state(self, sample: zenoh.Sample) -> None:
        self._newest = as_bytes(sample.payload)
        self._arrived.set()

    def _stop_heartbeat(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None


class _HeartbeatSender:
    """Says `owner` on the heartbeat key, again and again, until stopped."""

    def __init__(self, session: zenoh.Session, owner: str, period_s: float) -> None:
        self.owner = owner
        self._period_s = period_s
        self._publisher = session.declare_publisher(
            keys.HEARTBEAT,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="bus heartbeat", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Fall silent."""
        self._end.set()
        self._thread.join()

    def _beat(self) -> None:
        beat = self.owner.encode()
        try:
            while not self._end.wait(self._period_s):
                self._publisher.put(beat)
            self._publisher.undeclare()
        except zenoh.ZError as err:  # the session was closed, as at the end of the process
            _LOG.debug("the heartbeat ends: %s", err)

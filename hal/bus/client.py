"""The client's end of the link: the HAL process's arm and camera, as if they were in this process."""

from __future__ import annotations

import atexit
import logging
import threading
import uuid
from types import TracebackType
from typing import Self

import zenoh

from hal.base.background_loop import BackgroundLoop
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

    While it owns the lease it sends the heartbeat from a thread of its own: when this process dies, or blocks the
    interpreter for longer than 0.15 s in one piece, the servo brakes.

    Args:
        config: address of the HAL process.
        owner: name of this client; a random suffix distinguishes two of the same name.
        clock: the wall clock.
    """

    def __init__(self, config: BusConfig | None = None, owner: str = "runtime", clock: Clock | None = None) -> None:
        self._config = config or BusConfig()
        self._suffix = uuid.uuid4().hex[:8]
        self._owner = f"{owner}-{self._suffix}"
        self._clock = clock or WallClock()
        self._link: BusLink | None = None
        self._states: Listener | None = None
        self._newest = b""  # encoded: only a state that is read gets decoded
        self._arrived = threading.Event()
        self._heartbeat: _HeartbeatSender | None = None

    # --- Connection -----------------------------------------------------------------------------------------------

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
                f"bus: the HAL process at {self._config.endpoint} publishes no arm state. Check its log, then the arm.",
                code="no_state",
            )
        self._link, self._states = link, states
        atexit.register(self.disconnect)  # a program that ends without it must leave no thread inside Zenoh

    def disconnect(self) -> None:
        """Release the lease, if this client owns it, and close the link. No effect when not connected."""
        link, states = self._link, self._states
        if link is None or states is None:
            return
        atexit.unregister(self.disconnect)
        try:
            if self._heartbeat is not None:
                self.release()
        except HalTimeoutError:
            pass  # the HAL process is gone; without the heartbeat the lease would lapse anyway
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
            # What kept this process from running kept its listener from it as well: a newer state may be waiting.
            self._arrived.clear()
            self._arrived.wait(self._config.state_max_age_s)
            state, age_s = self._newest_state()
        if age_s > self._config.state_max_age_s:
            raise HalTimeoutError(
                f"bus: the newest arm state from {self._config.endpoint} is {age_s:.2f} s old (allowed "
                f"{self._config.state_max_age_s} s). The HAL process is gone or its arm is silent: check its log.",
                code="stale_state",
            )
        return state

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Send one setpoint (see `hal.base.arm.Arm.send`)."""
        return decode(self._connected().request(keys.SEND, encode(setpoint), self._owner_name()), ArmSetpoint)

    def stop(self, reason: str = "") -> None:
        """Brake, hold, and latch, whichever client owns the lease; returns when the servo has accepted it.

        Raises:
            HalTimeoutError: no answer: use the switch on the arm.
        """
        self._connected().request(keys.STOP, reason.encode(), self._owner_name())

    # --- Servo ----------------------------------------------------------------------------------------------------

    def claim(self, owner: str = "") -> None:
        """Claim the command lease (see `hal.base.arm.ServoedArm.claim`) and start the heartbeat.

        Args:
            owner: name for this lease; default is the one of the constructor.
        """
        link = self._connected()
        name = f"{owner}-{self._suffix}" if owner else self._owner
        link.request(keys.CLAIM, owner=name)
        if self._heartbeat is None or self._heartbeat.owner != name:
            self._stop_heartbeat()
            self._heartbeat = _HeartbeatSender(link.session, name, 1.0 / self._config.heartbeat_rate_hz)
            self._heartbeat.start()

    def release(self) -> None:
        """Release the lease (see `hal.base.arm.ServoedArm.release`)."""
        link = self._connected()
        name = self._owner_name()
        try:
            link.request(keys.RELEASE, owner=name)
        finally:
            self._stop_heartbeat()

    def stream(self, chunk: TrajectoryChunk) -> None:
        """Queue a trajectory chunk; returns when the servo has accepted it (see `hal.base.arm.ServoedArm.stream`)."""
        self._connected().request(keys.CHUNK, encode(chunk), self._owner_name())

    def status(self) -> ServoStatus:
        """Request the servo's present status.

        Requested, not cached: after `stream()` a published one may still describe the trajectory before.
        """
        return decode(self._connected().request(keys.READ_STATUS), ServoStatus)

    def rearm(self) -> None:
        """Clear a latched stop (see `hal.base.arm.ServoedArm.rearm`)."""
        self._connected().request(keys.REARM, owner=self._owner_name())  # this frees the lease
        self._stop_heartbeat()

    # --- Inside ---------------------------------------------------------------------------------------------------

    def _newest_state(self) -> tuple[ArmState, float]:
        """Return the newest measurement received, and its age [s]."""
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


class _HeartbeatSender(BackgroundLoop):
    """A thread that publishes `owner` on the heartbeat key every `period_s` [s]."""

    def __init__(self, session: zenoh.Session, owner: str, period_s: float) -> None:
        super().__init__("bus heartbeat")
        self.owner = owner
        self._period_s = period_s
        self._publisher = session.declare_publisher(
            keys.HEARTBEAT,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.DROP,  # a late heartbeat is worth no more than the next one
            express=True,  # sent at once, not collected into a batch
        )

    def _run(self) -> None:
        payload = self.owner.encode()
        try:
            while not self._stop_requested.wait(self._period_s):
                self._publisher.put(payload)
            self._publisher.undeclare()
        except zenoh.ZError as err:  # the session was closed, as at the end of the process
            _LOG.debug("the heartbeat ends: %s", err)

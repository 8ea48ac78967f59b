"""The client's end of the link: the HAL process's arm and camera, as if they were in this process."""

from __future__ import annotations

import atexit
import logging
import threading
from types import TracebackType
from typing import Self

import zenoh

from hal.base.background_loop import BackgroundLoop
from hal.base.clock import Clock, WallClock
from hal.base.errors import HalError, HalTimeoutError, InvalidMessageError, NotConnectedError
from hal.base.messages import ArmSetpoint, ArmState, ServoStatus, TrajectoryChunk
from hal.bus import keys
from hal.bus.authentication import LeaseGrant
from hal.bus.codec import decode, encode
from hal.bus.link import BusLink
from hal.bus.rate_limit import LimitedLog
from hal.bus.remote_camera import RemoteCamera as RemoteCamera  # noqa: PLC0414 (a re-export)
from hal.bus.service import Listener, as_bytes
from hal.bus.session import BusConfig

_LOG = logging.getLogger(__name__)
_MAX_REASON_BYTES = 1000  # the HAL drops a message that is far too long, and a stop must arrive


class RemoteArm:
    """The servoed arm of a HAL process (`hal.base.arm.ServoedArm`).

    While it owns the lease it sends the heartbeat from a thread of its own: when this process dies, or blocks the
    interpreter for longer than 0.15 s in one piece, the servo brakes.

    Args:
        config: address of the HAL process.
        owner: name of this client; the HAL adds a suffix, which distinguishes two of the same name.
        clock: the wall clock.
    """

    def __init__(self, config: BusConfig | None = None, owner: str = "runtime", clock: Clock | None = None) -> None:
        self._config = config or BusConfig()
        self._name = owner
        self._clock = clock or WallClock()
        self._link: BusLink | None = None
        self._states: Listener | None = None
        self._newest: ArmState | None = None
        self._arrived = threading.Event()
        self._heartbeat: _HeartbeatSender | None = None
        self._dropped = LimitedLog(_LOG)

    # --- Connection -----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the link and wait for the arm's first state. Harmless when open.

        Raises:
            HalTimeoutError: no HAL process answers, or it publishes no state.
            HalError: a program answers that is not a HAL of this user (`unverified_hal`).
        """
        if self._link is not None:
            return
        link = BusLink(self._config, self._clock, "the remote arm")
        self._arrived.clear()
        self._newest = None
        states = Listener(link.session, keys.STATE, lambda sample: self._on_state(link, sample))
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
        except HalError:
            pass  # the HAL process is gone, or has another owner; without the heartbeat the lease would lapse anyway
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
        return decode(self._command(keys.SEND, encode(setpoint)), ArmSetpoint)

    def stop(self, reason: str = "") -> None:
        """Brake, hold, and latch, whichever client owns the lease; returns when the servo has accepted it.

        Raises:
            HalTimeoutError: no answer: use the switch on the arm.
        """
        self._command(keys.STOP, reason.encode()[:_MAX_REASON_BYTES])

    # --- Servo ----------------------------------------------------------------------------------------------------

    def claim(self, owner: str = "") -> None:
        """Claim the command lease (see `hal.base.arm.ServoedArm.claim`) and start the heartbeat.

        Args:
            owner: name for this lease; default is the one of the constructor.
        """
        link, name, present = self._connected(), owner or self._name, self._heartbeat
        again = present is not None and present.name == name
        grant = decode(link.request(keys.CLAIM, present.grant.prove() if present and again else b"", name), LeaseGrant)
        if present is None or present.grant != grant:
            self._stop_heartbeat()
            self._heartbeat = _HeartbeatSender(link, name, grant, 1.0 / self._config.heartbeat_rate_hz)
            self._heartbeat.start()

    def release(self) -> None:
        """Release the lease (see `hal.base.arm.ServoedArm.release`)."""
        try:
            self._command(keys.RELEASE)
        finally:
            self._stop_heartbeat()

    def stream(self, chunk: TrajectoryChunk) -> None:
        """Queue a trajectory chunk; returns when the servo has accepted it (see `hal.base.arm.ServoedArm.stream`)."""
        self._command(keys.CHUNK, encode(chunk))

    def status(self) -> ServoStatus:
        """Request the servo's present status.

        Requested, not cached: after `stream()` a published one may still describe the trajectory before.
        """
        return decode(self._connected().request(keys.READ_STATUS), ServoStatus)

    def rearm(self) -> None:
        """Clear a latched stop (see `hal.base.arm.ServoedArm.rearm`).

        Raises:
            LeaseError: nothing is stopped, and another client owns the lease.
        """
        owned_before = self._heartbeat is not None
        self.claim(self._heartbeat.name if self._heartbeat else "")  # succeeds while the stop is latched
        status = decode(self._command(keys.REARM), ServoStatus)
        if not status.owner:
            self._stop_heartbeat()
        elif not owned_before:
            self.release()

    # --- Inside ---------------------------------------------------------------------------------------------------

    def _newest_state(self) -> tuple[ArmState, float]:
        """Return the newest measurement received, and its age [s]."""
        link, state = self._connected(), self._newest
        assert state is not None  # `connect` has waited for the first
        return state, self._clock.now_s() + link.clock_offset_s - state.stamp_s

    def _connected(self) -> BusLink:
        if self._link is None:
            raise NotConnectedError("the remote arm")
        return self._link

    def _command(self, key: str, payload: bytes = b"") -> bytes:
        """Return the answer to a command, signed by the lease's secret when this client owns it."""
        present = self._heartbeat
        if present is None:
            return self._connected().request(key, payload, self._name)
        return self._connected().request(key, payload, present.grant.owner, present.grant)

    def _on_state(self, link: BusLink, sample: zenoh.Sample) -> None:
        if not link.is_signed(keys.STATE, sample.payload, sample.attachment):
            self._dropped.warning("bus: an arm state was dropped: the HAL did not sign it.")
            return
        try:
            state = decode(as_bytes(sample.payload), ArmState)
        except InvalidMessageError as error:
            self._dropped.warning("bus: an arm state was dropped: %s", error)
            return
        newest = self._newest
        if newest is None or state.stamp_s > newest.stamp_s:  # a state sent again is older
            self._newest = state
        self._arrived.set()

    def _stop_heartbeat(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None


class _HeartbeatSender(BackgroundLoop):
    """A thread that publishes the heartbeat of the lease `grant` every `period_s` [s]."""

    def __init__(self, link: BusLink, name: str, grant: LeaseGrant, period_s: float) -> None:
        super().__init__("bus heartbeat")
        self.name = name
        """Name under which the lease was claimed."""
        self.grant = grant
        self._link = link
        self._period_s = period_s
        self._publisher = link.session.declare_publisher(
            keys.HEARTBEAT,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.DROP,  # a late heartbeat is worth no more than the next one
            express=True,  # sent at once, not collected into a batch
        )

    def _run(self) -> None:
        try:
            while not self._stop_requested.wait(self._period_s):
                self._publisher.put(b"", attachment=self._link.sign_heartbeat(self.grant))
            self._publisher.undeclare()
        except zenoh.ZError as err:  # the session was closed, as at the end of the process
            _LOG.debug("the heartbeat ends: %s", err)

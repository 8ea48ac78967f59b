"""The HAL's end of the link: publishes state, status and frames, and takes commands for one servo.

Messages, directions and quality of service:

* State and status: put at 100 Hz, REAL_TIME, DROP, express. The newest replaces the one before.
* Health: put once a second.
* Heartbeat: put by the owner at 50 Hz, the same, signed. One may be lost; seven in a row make the servo brake.
* Trajectory chunks: acked queries, not puts. A lost chunk would show only as a buffer underrun, and a rejected one not
  at all; an answer costs about 1 ms every 0.1 s.
* Stop, re-arm, claim, release, send, status: acked queries, each on a thread of its own, so that a stop waits for no
  other. The stop needs no lease: every client may stop the arm, also on a Unix socket (`hal.bus.stop_socket`).
* Frames: put, DATA_LOW, DROP, in shared memory, only while a client listens.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.metadata import version
from threading import Event
from typing import Any, Protocol

import zenoh

from hal.base.arm import ServoedArm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.base.errors import HalError, InvalidMessageError, LeaseError
from hal.base.messages import ArmSetpoint, ServoHealth, TrajectoryChunk
from hal.bus import keys
from hal.bus.authentication import NO_SECRET, LeaseAuthority, Request, compute_code
from hal.bus.codec import VERSION, Hello, decode, decode_text, encode
from hal.bus.frames import FrameBuffers, FrameStamp, existing_segments, mapped_segments, unlink_segments
from hal.bus.rate_limit import LimitedLog, StateChangeWarning
from hal.bus.runtime_files import make_secret
from hal.bus.service import Listener, RequestHandler, Service, ServiceThread, as_bytes
from hal.bus.session import BusConfig, has_shared_memory, open_session
from hal.bus.stop_socket import StopAnswer, StopSocket

_LOG = logging.getLogger(__name__)
_ANONYMOUS = "an anonymous client"
_FRAME_TIMEOUT_S = 1.0
_RETRY_S = 0.2  # pause after a camera error, so that a camera that fails at once does not occupy a core
_HEALTH_PERIOD_S = 1.0
_MAX_STOPS_HZ = 50.0  # once one is latched the next ones change nothing, and any program can send them
_HEARTBEATS_WAITING = 16  # 0.3 s at 50 Hz, twice the heartbeat's timeout


class OwnedServo(ServoedArm, Protocol):
    """Interface of `hal.servo.servo.Servo` for the server: a thread-safe servoed arm whose commands name the owner."""

    def release(self, owner: str | None = None) -> None: ...

    def heartbeat(self, owner: str | None = None) -> None: ...

    def stream(self, chunk: TrajectoryChunk, owner: str | None = None) -> None: ...

    def send(self, setpoint: ArmSetpoint, owner: str | None = None) -> ArmSetpoint: ...

    def stop(self, reason: str = ...) -> None: ...

    def rearm(self, owner: str | None = None) -> None: ...

    def health(self) -> ServoHealth: ...


class HalServer:
    """Serves one servo and one camera, both connected by the caller, until `close()`.

    Args:
        servo: thread-safe; its ticks run elsewhere.
        camera: used by this server's frame thread alone.
        clock: the wall clock; paces the publishing and stamps the messages.
        config: address to listen on.

    Raises:
        HalError: the port is taken.
    """

    def __init__(self, servo: OwnedServo, camera: Camera, clock: Clock, config: BusConfig) -> None:
        self._servo = servo
        self._camera = camera
        self._clock = clock
        self._config = config
        self._closing = Event()
        self.failed = Event()
        """Set when an error ended a thread of the server; the process should then stop the arm and end."""
        # Before the session: a client that can connect finds the secret.
        self._secret = NO_SECRET if config.keys else make_secret(config.port)
        shared = config.shared_memory and has_shared_memory()
        with ExitStack() as undo:
            self._buffers = FrameBuffers(camera.intrinsics, shared=shared)
            undo.callback(self._buffers.close)
            before = existing_segments()
            self._session = open_session(config, listen=True, shared_memory=shared)
            undo.callback(self._session.close)
            self._segments = mapped_segments() - before
            self._stop_socket = StopSocket(config.robot, config.port, servo.stop, self._read_stop_answer)
            undo.pop_all()
        self._authority = LeaseAuthority()
        self._unreadable_reasons = LimitedLog(_LOG)
        self._threads: list[ServiceThread] = []
        self._start_publishing()
        any_client: dict[str, Any] = {"rate_hz": _MAX_STOPS_HZ, "allow_anonymous": True}
        self._services = [
            Service(
                self._session, key, handle, self.failed.set, self._secret, **(any_client if key == keys.STOP else {})
            )
            for key, handle in self._request_handlers()
        ]

    def __enter__(self) -> HalServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop all services, end all threads, and free the shared memory. No effect when closed before."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._stop_socket.close()
        for service in self._services:
            service.close()
        self._heartbeats.close()
        self._frame_listeners.undeclare()
        for thread in self._threads:
            thread.join()
        self._session.close()
        self._buffers.close()
        unlink_segments(self._segments)

    def _start_publishing(self) -> None:
        session = self._session
        urgent = {
            "priority": zenoh.Priority.REAL_TIME,
            "congestion_control": zenoh.CongestionControl.DROP,
            "express": True,
        }
        self._state = session.declare_publisher(keys.STATE, **urgent)
        self._status = session.declare_publisher(keys.STATUS, **urgent)
        self._health = session.declare_publisher(keys.HEALTH)
        # Of lower priority than states and requests, which a frame of megabytes must not delay.
        self._frames = session.declare_publisher(
            keys.FRAME, priority=zenoh.Priority.DATA_LOW, congestion_control=zenoh.CongestionControl.DROP
        )
        self._frame_listeners = self._frames.declare_matching_listener(zenoh.handlers.RingChannel(1))
        self._heartbeats = Listener(
            session,
            keys.HEARTBEAT,
            self._on_heartbeat,
            waiting=_HEARTBEATS_WAITING,
            on_failure=self.failed.set,
        )
        loops: dict[str, Callable[[], None]] = {
            "bus state": self._publish_state,
            "bus health": self._publish_health,
            "bus frames": self._publish_frames,
        }
        for name, loop in loops.items():
            self._threads.append(ServiceThread(name, loop, self.failed.set))
            self._threads[-1].start()

    # --- Publishing -----------------------------------------------------------------------------------------------

    def _publish_state(self) -> None:
        period_s = 1.0 / self._config.state_rate_hz
        warning = StateChangeWarning(_LOG, "arm state not published")
        due_s = self._clock.now_s()
        while not self._closing.is_set():
            self._put(self._status, keys.STATUS, encode(self._servo.status()))  # first: for an arm that is silent
            try:
                self._put(self._state, keys.STATE, encode(self._servo.read_state()))
                warning.clear()
            except HalError as error:
                warning.warn(error)
            # A late cycle shifts the following ones: nothing is sent twice to catch up.
            due_s = max(due_s + period_s, self._clock.now_s())
            self._clock.sleep_until(due_s)

    def _publish_health(self) -> None:
        while not self._closing.wait(_HEALTH_PERIOD_S):
            self._put(self._health, keys.HEALTH, encode(self._servo.health()))

    def _put(self, publisher: zenoh.Publisher, key: str, payload: bytes) -> None:
        publisher.put(payload, attachment=compute_code(self._secret, key, payload))

    def _while_listened(self) -> Iterator[None]:
        """Yield repeatedly while a client listens to frames; wait while none does; end at `close()`."""
        changes = self._frame_listeners.handler
        # A client that kept its session through a restart of this process listens already.
        listened = self._frames.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue] (its stub is wrong)
        while not self._closing.is_set():
            try:
                change = changes.try_recv() if listened else changes.recv()
            except zenoh.ZError:  # closed
                return
            listened = listened if change is None else change.matching
            if listened:
                yield

    def _publish_frames(self) -> None:
        warning = StateChangeWarning(_LOG, "frames not published")
        for _ in self._while_listened():
            try:
                frame = self._camera.wait_for_frame(_FRAME_TIMEOUT_S)
                payload = self._buffers.fill(frame)
            except HalError as error:
                warning.warn(error)
                self._closing.wait(_RETRY_S)
                continue
            warning.clear()
            stamp = FrameStamp(sent_s=self._clock.now_s(), exposed_s=frame.stamp_s, sequence=frame.sequence)
            packed = stamp.pack()  # signed alone: a code over megabytes would cost milliseconds a frame
            self._frames.put(payload, attachment=packed + compute_code(self._secret, keys.FRAME, packed))

    # --- Commands -------------------------------------------------------------------------------------------------

    def _on_heartbeat(self, sample: zenoh.Sample) -> None:
        try:
            request = Request.unpack(keys.HEARTBEAT, b"", as_bytes(sample.attachment))
            self._servo.heartbeat(self._authority.owner_of(request))
        except (LeaseError, InvalidMessageError):
            pass  # a client that has just lost the lease gets the error of its next command

    def _check_user(self, request: Request) -> None:
        if not request.is_signed_by(self._secret):
            raise LeaseError(
                f"bus: {request.name or _ANONYMOUS!r} did not sign {request.key} with this link's secret. Run client "
                f"and HAL as the same user, or both with `--keys`.",
                code="unverified_client",
            )

    def _read_stop_answer(self) -> StopAnswer:
        status = self._servo.status()
        return StopAnswer(status.mode.value, status.reason, status.owner)

    def _request_handlers(self) -> list[tuple[str, RequestHandler]]:
        servo, owner_of = self._servo, self._authority.owner_of

        def claim(request: Request) -> bytes:
            self._check_user(request)
            self._authority.check_claim(request)
            grant = self._authority.grant_for(request)
            servo.claim(grant.owner)
            self._authority.put_in_force(grant)  # after the servo: a rejected claim changes nothing
            return encode(grant)

        def release(request: Request) -> bytes:
            servo.release(owner_of(request))
            return b""

        def stream(request: Request) -> bytes:
            servo.stream(decode(request.payload, TrajectoryChunk), owner=owner_of(request))
            return b""

        def send(request: Request) -> bytes:
            return encode(servo.send(decode(request.payload, ArmSetpoint), owner=owner_of(request)))

        def rearm(request: Request) -> bytes:
            servo.rearm(owner_of(request))
            return encode(servo.status())

        def status(request: Request) -> bytes:
            self._check_user(request)
            return encode(servo.status())

        return [
            (keys.STOP, self._stop),
            (keys.CLAIM, claim),
            (keys.RELEASE, release),
            (keys.CHUNK, stream),
            (keys.SEND, send),
            (keys.REARM, rearm),
            (keys.READ_STATUS, status),
            (keys.HELLO, self._hello),  # last: a client that gets its answer finds all other services running
        ]

    def _stop(self, request: Request) -> bytes:
        self._servo.stop(self._decode_reason(request.payload) or f"stop requested by {request.name or _ANONYMOUS}")
        return b""

    def _hello(self, request: Request) -> bytes:
        self._check_user(request)
        versions = [f"{name}={version(name)}" for name in ("z1-grasp", "eclipse-zenoh")]
        hello = Hello(robot=self._config.robot, versions=(f"protocol={VERSION}", *versions), now_s=self._clock.now_s())
        return encode(hello)

    def _decode_reason(self, reason: bytes) -> str:
        # A stop is executed whatever its payload.
        try:
            return decode_text(reason, "the reason")
        except InvalidMessageError as error:
            self._unreadable_reasons.warning("a stop has an unreadable reason: %s", error)
            return ""

"""The camera of a HAL process, over the link."""

from __future__ import annotations

import atexit
import logging
import threading
from collections import deque
from types import TracebackType
from typing import Self

import numpy as np
import zenoh

from hal.base.clock import Clock, WallClock
from hal.base.errors import HalTimeoutError, InvalidMessageError, NotConnectedError
from hal.base.messages import Intrinsics, RgbdFrame
from hal.bus import keys
from hal.bus.authentication import CODE_BYTES
from hal.bus.codec import decode
from hal.bus.frames import FrameStamp
from hal.bus.link import BusLink
from hal.bus.rate_limit import LimitedLog
from hal.bus.service import Listener, as_bytes
from hal.bus.session import BusConfig

_LOG = logging.getLogger(__name__)
_LATENCIES_KEPT = 1000  # half a minute at 30 Hz
_FRAMES_WAITING = 2


class RemoteCamera:
    """The camera of a HAL process (`hal.base.camera.Camera`).

    It keeps only the newest frame, still encoded; each waiting thread decodes it for itself. Any number of threads may
    wait at once. It listens from the first call that waits to the first frame for which no thread waits: an unused
    frame is neither sent nor, in the twin, rendered.

    Args:
        config: address of the HAL process.
        clock: the wall clock.
    """

    def __init__(self, config: BusConfig | None = None, clock: Clock | None = None) -> None:
        self._config = config or BusConfig()
        self._clock = clock or WallClock()
        self._link: BusLink | None = None
        self._intrinsics: Intrinsics | None = None
        self._dropped = LimitedLog(_LOG)
        self._changed = threading.Condition()
        # Below, all under `_changed`.
        self._listener: Listener | None = None
        self._waiting = 0
        self._newest: tuple[FrameStamp, zenoh.ZBytes] | None = None
        self._last_sequence: int | None = None
        self._latencies_ms: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self.lost_frames = 0
        """Number of frames that were sent and never arrived, since `connect()`."""
        self.shared_memory = False
        """True when the last frame came through shared memory."""

    def connect(self) -> None:
        """Open the link and wait for the first frame. Harmless when open.

        Raises:
            HalTimeoutError: no HAL process answers, or it sends no frame.
        """
        if self._link is not None:
            return
        self.lost_frames = 0
        self._link = BusLink(self._config, self._clock, "the remote camera", shared_memory=self._config.shared_memory)
        atexit.register(self.disconnect)  # a program that ends without it must leave no thread inside Zenoh
        try:
            # At least 1 s: before the first frame the camera may have to start its stream.
            self._intrinsics = self.wait_for_frame(max(self._config.connect_timeout_s, 1.0)).intrinsics
        except (HalTimeoutError, InvalidMessageError):
            self.disconnect()
            raise
        self._latencies_ms.clear()

    def disconnect(self) -> None:
        """Close the link; a thread that waits for a frame gets `NotConnectedError`. No effect when not connected."""
        with self._changed:
            link, self._link = self._link, None
            listener, self._listener = self._listener, None
            self._newest = None
            self._changed.notify_all()
        if link is None:
            return
        atexit.unregister(self.disconnect)
        if listener is not None:
            listener.close()
        link.close()

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()

    @property
    def intrinsics(self) -> Intrinsics:
        """Of both images of every frame (see `hal.base.camera.Camera.intrinsics`)."""
        if self._link is None or self._intrinsics is None:
            raise NotConnectedError("the remote camera")
        return self._intrinsics

    @property
    def frame_latencies_ms(self) -> tuple[float, ...]:
        """Latencies from the HAL's sending to the decoded frame here, of the last frames waited for [ms]."""
        return tuple(self._latencies_ms)

    def frame_latency_ms(self, percentile: float) -> float:
        """Return a percentile of `frame_latencies_ms` [ms]; 0 before the first."""
        latencies_ms = self.frame_latencies_ms
        return float(np.percentile(latencies_ms, percentile)) if latencies_ms else 0.0

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame exposed after this call began (see `hal.base.camera.Camera.wait_for_frame`).

        Raises:
            InvalidMessageError: a malformed frame arrived.
        """
        began_s = self._clock.now_s()
        with self._changed:
            link = self._connected()
            self._waiting += 1
            if self._listener is None:
                self._last_sequence = None  # frames of the time without a listener are not lost
                self._listener = Listener(link.session, keys.FRAME, self._on_frame, waiting=_FRAMES_WAITING)
        try:
            while True:
                stamp, payload = self._wait_for_newer(link, began_s, timeout_s)
                frame = self._decode(stamp, payload)
                if frame is not None:
                    self._latencies_ms.append(1e3 * (self._clock.now_s() + link.clock_offset_s - stamp.sent_s))
                    return frame
        finally:
            with self._changed:
                self._waiting -= 1

    def _connected(self) -> BusLink:
        if self._link is None:
            raise NotConnectedError("the remote camera")
        return self._link

    def _wait_for_newer(self, link: BusLink, began_s: float, timeout_s: float) -> tuple[FrameStamp, zenoh.ZBytes]:
        give_up_s = began_s + timeout_s
        with self._changed:
            while True:
                if self._link is not link:
                    raise NotConnectedError("the remote camera")
                if self._newest is not None and self._newest[0].exposed_s >= began_s + link.clock_offset_s:
                    return self._newest
                left_s = give_up_s - self._clock.now_s()
                if left_s <= 0:
                    raise HalTimeoutError(
                        f"bus: no new frame from {self._config.endpoint} within {timeout_s} s. "
                        f"Check the HAL process's log and the camera's cable.",
                        code="no_frame",
                    )
                self._changed.wait(left_s)

    def _decode(self, stamp: FrameStamp, payload: zenoh.ZBytes) -> RgbdFrame | None:
        shared = payload.as_shm()
        data = payload.to_bytes()
        # Zenoh reclaims shared memory from a reader that stalls for too long: the copy may then be torn.
        if shared is not None and not shared.is_valid():
            _LOG.warning("bus: a frame was overwritten while it was read; waiting for the next.")
            with self._changed:
                if self._newest is not None and self._newest[0] is stamp:
                    self._newest = None
            return None
        self.shared_memory = shared is not None
        return decode(data, RgbdFrame)

    def _on_frame(self, sample: zenoh.Sample) -> None:
        attachment, link = as_bytes(sample.attachment), self._link
        packed, code = attachment[:-CODE_BYTES], attachment[-CODE_BYTES:]
        if link is None or not link.is_signed(keys.FRAME, packed, code):
            self._dropped.warning("bus: a frame was dropped: the HAL did not sign it.")
            return
        stamp = FrameStamp.unpack(packed)
        with self._changed:
            if self._listener is None:  # disconnected
                return
            if not self._waiting:
                self._listener.close()
                self._listener = self._newest = None
                return
            if self._last_sequence is not None and stamp.sequence > self._last_sequence + 1:
                self.lost_frames += stamp.sequence - self._last_sequence - 1
            self._last_sequence = stamp.sequence
            self._newest = (stamp, sample.payload)
            self._changed.notify_all()

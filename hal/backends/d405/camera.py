"""RealSense D405 behind the camera contract; the twin's camera, too, runs through librealsense."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from hal.backends.d405.recovery import RecoveryPolicy, RecoveryStep, StampConverter
from hal.backends.d405.session import D405CameraConfig, D405Session, RawFrame, describe_missing, find_device
from hal.base.clock import Clock, WallClock, unix_offset_s
from hal.base.d405 import FrameSource
from hal.base.errors import CameraError, HalTimeoutError, NotConnectedError
from hal.base.messages import Intrinsics, RgbdFrame

logger = logging.getLogger(__name__)

_POLL_S = 0.25  # between two checks of a silent camera, and of the bus [s]


@dataclass(slots=True, kw_only=True)
class CameraHealth:
    """Counts of frames and recoveries since the camera was connected."""

    frames: int = 0
    """Frames delivered."""
    repeated: int = 0
    """Frames discarded as repetitions of the last one."""
    stale: int = 0
    """Frames discarded as older than `max_age_s`."""
    torn: int = 0
    """Frames discarded for colour and depth of different instants."""
    restarts: int = 0
    """Restarts of the streams."""
    resets: int = 0
    """Resets of the hardware."""
    reconnections: int = 0
    """Returns to the bus."""


class D405Camera:
    """`hal.base.camera.Camera` of a D405, for one thread.

    Both images of a frame share the pinhole of the depth image, which keeps its pixels; colour is undistorted onto it,
    black where the imager does not reach. When frames stop, waiting for one also recovers the camera: the streams are
    restarted, then the hardware is reset, then the device is searched for on the bus until it is back.

    Args:
        config: streams and timeouts.
        clock: source of stamps and timeouts; by default the source's, or the wall clock.
        source: optics of a twin that replaces the real camera.
    """

    def __init__(
        self,
        config: D405CameraConfig | None = None,
        clock: Clock | None = None,
        source: FrameSource | None = None,
    ) -> None:
        self.config = config if config is not None else D405CameraConfig()
        self.clock: Clock = clock or (source.clock if source is not None else WallClock())
        self.health = CameraHealth()
        self._source = source
        self._undo: ExitStack | None = None
        self._rs: Any = None
        self._session: D405Session | None = None
        self._intrinsics: Intrinsics | None = None
        self._serial = self.config.serial

    def connect(self) -> None:
        """Find the camera, start its streams, and let it warm up.

        Raises:
            SdkMissingError: no librealsense on this machine.
            HalTimeoutError: no such camera on the bus, or no frame from it.
            CameraError: the camera rejects the requested streams.
        """
        if self._undo is not None:
            return
        config = self.config
        self.health = CameraHealth()
        self._recovery, self._stamps = RecoveryPolicy(config.silence_s), StampConverter(config.max_age_s)
        self._last_number, self._sequence, self._offset = -1, 0, 0
        self._rs = import_module("hal.compat.realsense")
        with ExitStack() as undo:
            if self._source is not None:
                self._serial = config.serial or self._rs.SERIAL
                undo.enter_context(self._rs.plugged(self._source, self._serial))
            undo.callback(self._close)
            self._open(self._find())
            first = self._next(config.connect_timeout_s)
            while self._next(config.connect_timeout_s).stamp_s < first.stamp_s + config.warm_up_s:
                pass
            self.health.frames = 0
            self._undo = undo.pop_all()

    def disconnect(self) -> None:
        """End the streams. Harmless when not connected."""
        undo, self._undo = self._undo, None
        if undo is not None:
            undo.close()

    @property
    def intrinsics(self) -> Intrinsics:
        """Pinhole of both images of every frame.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._require_connection()
        assert self._intrinsics is not None
        return self._intrinsics

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame exposed after this call began.

        A restart or reset that falls into the call may make it take longer than `timeout_s`, by about 1 s.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: no frame within `timeout_s` [s]; the message names the recovery under way.
        """
        self._require_connection()
        return self._next(timeout_s)

    def set_exposure(self, exposure_us: int | None = None, gain: int | None = None) -> None:
        """Set exposure time [µs] and gain from now on, also after a reset; None for both = automatic.

        Raises:
            NotConnectedError: before `connect()`, or while the camera is off the bus.
            InvalidValueError: out of range.
        """
        self._require_connection()
        self.config = replace(self.config, exposure_us=exposure_us, gain=gain)
        if self._session is None:
            raise NotConnectedError(f"the D405 {self._serial}")
        self._session.set_exposure(exposure_us, gain)

    def _next(self, timeout_s: float) -> RgbdFrame:
        called_s = self.clock.now_s()
        while (left_s := called_s + timeout_s - self.clock.now_s()) > 0:
            before_s, session = self.clock.now_s(), self._session
            raw = None
            if session is not None:
                raw = session.wait(min(left_s, _POLL_S))
            else:
                self.clock.sleep_until(before_s + min(left_s, _POLL_S))
            stamp_s = self._validate(session, raw) if session is not None and raw is not None else None
            if stamp_s is not None and session is not None and raw is not None:
                self._recovery.on_frame()
                if stamp_s >= called_s - 1e-9:
                    return self._compose(session, raw, stamp_s)
            else:
                self._recover(self._recovery.on_silence(self.clock.now_s() - before_s))
        raise HalTimeoutError(
            f"D405 {self._serial}: no frame within {timeout_s:g} s: {self._describe_recovery()}.", code="no_frame"
        )

    def _validate(self, session: D405Session, raw: RawFrame) -> float | None:
        """Return the exposure time of a frame [s]; None when the frame is discarded."""
        if raw.number == self._last_number:
            self.health.repeated += 1
            return None
        if session.is_torn(raw):
            self.health.torn += 1
            return None
        stamp_s = self._stamps.convert(raw.device_s, unix_offset_s(self.clock), self.clock.now_s())
        if stamp_s is None:
            self.health.stale += 1
            return None
        if raw.number < self._last_number or self._last_number < 0:  # the device has restarted its count
            self._offset = self._sequence + 1 - raw.number
        self._last_number = raw.number
        return stamp_s

    def _compose(self, session: D405Session, raw: RawFrame, stamp_s: float) -> RgbdFrame:
        colour, depth_m = session.images(raw)
        self._sequence = raw.number + self._offset
        self.health.frames += 1
        return RgbdFrame(
            colour=colour,
            depth_m=depth_m,
            intrinsics=session.intrinsics,
            stamp_s=stamp_s,
            sequence=self._sequence,
            serial=session.serial,
        )

    def _recover(self, step: RecoveryStep | None) -> None:
        if step is None:
            return
        session = self._session
        if session is not None:
            logger.warning("D405 %s: no frames; %s", self._serial, step.value)
        try:
            if step is RecoveryStep.RESTART and session is not None:
                self.health.restarts += 1
                self._reopen()
            elif step is RecoveryStep.RESET and session is not None:
                self.health.resets += 1
                session.device.hardware_reset()
                self._close()
            else:
                self._reopen()
        # One step of several: its failure is logged, and the next one follows.
        except (RuntimeError, CameraError) as error:
            logger.warning("D405 %s: that failed: %s", self._serial, error)

    def _reopen(self) -> None:
        was_lost = self._session is None
        self._close()
        device = find_device(self._rs, self._serial)
        if device is None:
            self._recovery.on_lost()
            return
        self._open(device)
        if was_lost:
            self.health.reconnections += 1
            self._recovery.on_found()

    def _find(self) -> Any:
        end_s = self.clock.now_s() + self.config.search_s
        while (device := find_device(self._rs, self._serial)) is None:
            if self.clock.now_s() >= end_s:
                raise HalTimeoutError(
                    f"D405: no camera within {self.config.search_s:g} s: {describe_missing(self._rs, self._serial)}",
                    code="no_camera",
                )
            self.clock.sleep_until(min(self.clock.now_s() + _POLL_S, end_s))
        return device

    def _open(self, device: Any) -> None:
        self._session = D405Session(self._rs, device, self.config)
        self._serial, self._intrinsics = self._session.serial, self._session.intrinsics
        self._last_number = -1

    def _close(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.stop()

    def _describe_recovery(self) -> str:
        step = self._recovery.step
        if step is None:
            return "it streams, but no valid frame arrived in that time"
        return f"its frames stopped, and {step.value}"

    def _require_connection(self) -> None:
        if self._undo is None:
            raise NotConnectedError("the D405")

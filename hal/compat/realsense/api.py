"""Classes of pyrealsense2 with support for twins; everything else is librealsense's own.

Names, arguments and error texts are librealsense's. Two facts about the native classes shape this file:
`pipeline.set_device` binds a pipeline to a device for good and makes it ignore serial numbers and files in a `config`;
a device cannot be added to a `context` from Python. In lock-step, frames are made by waiting for a pipeline, or for a
queue that it was started with; callbacks and syncers need free run.
"""

from __future__ import annotations

import threading
from contextlib import nullcontext

from hal.compat.realsense import port
from hal.compat.realsense.device import TwinDevice
from hal.compat.realsense.library import native as rs

_NO_DEVICE = "No device connected"


class config(rs.config):
    """Configuration that keeps the values that the native one does not return."""

    def __init__(self) -> None:
        super().__init__()
        self.requested_serial: str | None = None
        self.is_file = False
        self.all_streams = False

    def enable_device(self, serial: str) -> None:
        super().enable_device(serial)
        self.requested_serial = serial

    def enable_device_from_file(self, file_name: str, repeat_playback: bool = True) -> None:
        super().enable_device_from_file(file_name, repeat_playback)
        self.is_file = True

    def enable_all_streams(self) -> None:
        super().enable_all_streams()
        self.all_streams = True

    def disable_all_streams(self) -> None:
        super().disable_all_streams()
        self.all_streams = False

    def resolve(self, p: pipeline_wrapper) -> rs.pipeline_profile:
        return super().resolve(rs.pipeline_wrapper(p.pipeline.prepare(self)))

    def can_resolve(self, p: pipeline_wrapper) -> bool:
        try:
            return super().can_resolve(rs.pipeline_wrapper(p.pipeline.prepare(self)))
        except RuntimeError:
            return False

    def name_all_streams(self) -> None:
        """Name each stream of `enable_all_streams`, which finds none on a `software_device`."""
        if not self.all_streams:
            return
        super().disable_all_streams()
        super().enable_stream(rs.stream.depth)
        super().enable_stream(rs.stream.color)
        for imager in (1, 2):
            super().enable_stream(rs.stream.infrared, imager)


class pipeline_wrapper(rs.pipeline_wrapper):
    """Wrapper that keeps its pipeline."""

    def __init__(self, p: pipeline) -> None:
        super().__init__(p)
        self.pipeline = p


class pipeline(rs.pipeline):
    """Pipeline of a twin where one is plugged in, of a real camera otherwise, and of files."""

    def __init__(self, ctx: rs.context | None = None) -> None:
        super().__init__(*() if ctx is None else (ctx,))
        self._engine: rs.pipeline = self  # native pipeline that streams
        self._twin: TwinDevice | None = None
        self._had_twin = False
        self._streams = False

    def start(self, *args, **kwargs) -> rs.pipeline_profile:
        options = [*args, *kwargs.values()]
        request = next((option for option in options if isinstance(option, rs.config)), None)
        queue = next((option for option in options if isinstance(option, frame_queue)), None)
        if not self._streams:  # else the library raises its own error
            self._engine = self.prepare(request)
            self._twin = None if self._engine is not self else _twin_for(request)
        twin = self._twin
        if twin is not None and twin.source.lockstep and queue is None and len(options) > (request is not None):
            raise RuntimeError(
                "a twin in lock-step makes frames on demand, so a callback would never be called; wait for frames, "
                "start with a hal.compat.realsense.frame_queue, or run the twin on the wall clock."
            )
        with self._guard():
            profile = rs.pipeline.start(self._engine, *args, **kwargs)
        self._streams = True
        if twin is not None:
            twin.restart()
            if queue is not None:
                queue.twin = twin
        return profile

    def stop(self) -> None:
        with self._guard():
            rs.pipeline.stop(self._engine)
        self._streams = False

    def get_active_profile(self) -> rs.pipeline_profile:
        return rs.pipeline.get_active_profile(self._engine)

    def wait_for_frames(self, timeout_ms: int = 5000) -> rs.composite_frame:
        if self._lockstep():
            frames = self._pull(timeout_ms)
            if frames:
                return frames
            raise RuntimeError(self._describe_timeout(timeout_ms))
        try:
            return rs.pipeline.wait_for_frames(self._engine, timeout_ms)
        except RuntimeError as error:
            if self._streams and self._twin is not None and not self._twin.present:
                raise RuntimeError(self._describe_timeout(timeout_ms)) from error
            raise

    def try_wait_for_frames(self, timeout_ms: int = 5000) -> tuple[bool, rs.composite_frame]:
        if self._lockstep():
            frames = self._pull(timeout_ms)
            return bool(frames), frames
        return rs.pipeline.try_wait_for_frames(self._engine, timeout_ms)

    def poll_for_frames(self) -> rs.composite_frame:
        return self._pull(1000) if self._lockstep() else rs.pipeline.poll_for_frames(self._engine)

    def prepare(self, request: rs.config | None) -> rs.pipeline:
        """Return the native pipeline for `request`, bound to the right device.

        Raises:
            RuntimeError: the requested camera is not connected.
        """
        if isinstance(request, config) and request.is_file:
            return rs.pipeline()  # `set_device` takes precedence over a file, so the engine must be a plain one
        twin = _twin_for(request)
        if twin is not None:
            if isinstance(request, config):
                request.name_all_streams()
            self.set_device(twin.handle)
            self._had_twin = True
        elif self._had_twin:  # `set_device` cannot be undone: this pipeline would stream from the old twin
            raise RuntimeError(_NO_DEVICE)
        return self

    def _lockstep(self) -> bool:
        return self._streams and self._twin is not None and self._twin.source.lockstep

    def _pull(self, timeout_ms: int) -> rs.composite_frame:
        """Step the twin until it has frames or the timeout is over; return them, or an empty set."""
        assert self._twin is not None
        clock = self._twin.source.clock
        end_s = clock.now_s() + 1e-3 * timeout_ms
        frames = rs.pipeline.poll_for_frames(self._engine)
        while not frames and clock.now_s() < end_s:
            self._twin.step(end_s - clock.now_s())
            frames = rs.pipeline.poll_for_frames(self._engine)
        return frames

    def _describe_timeout(self, timeout_ms: int) -> str:
        if self._twin is not None and not self._twin.present:
            # librealsense's own text, in which the timeout follows without a space.
            return f"Device disconnected. Failed to reconnect: {_NO_DEVICE}{timeout_ms}"
        return f"Frame didn't arrive within {timeout_ms}"

    def _guard(self) -> threading.RLock | nullcontext:
        return self._twin.lock if self._twin is not None else nullcontext()


class frame_queue(rs.frame_queue):
    """Queue that steps a twin in lock-step while it is waited for."""

    def __init__(self, capacity: int = 1, keep_frames: bool = False) -> None:
        super().__init__(capacity, keep_frames)
        self.twin: TwinDevice | None = None

    def wait_for_frame(self, timeout_ms: int = 5000) -> rs.frame:
        return super().wait_for_frame(self._pull(timeout_ms))

    def try_wait_for_frame(self, timeout_ms: int = 5000) -> tuple[bool, rs.frame]:
        return super().try_wait_for_frame(self._pull(timeout_ms))

    def poll_for_frame(self) -> rs.frame:
        self._pull(1000)
        return super().poll_for_frame()

    def _pull(self, timeout_ms: int) -> int:
        """Step a twin in lock-step until it has a frame or the timeout is over; return the remaining time [ms]."""
        if self.twin is None or not self.twin.source.lockstep:
            return timeout_ms
        clock = self.twin.source.clock
        end_s = clock.now_s() + 1e-3 * timeout_ms
        while self.size() == 0 and clock.now_s() < end_s:
            self.twin.step(end_s - clock.now_s())
        return 1


class context(rs.context):
    """Context with the twins plugged in, or else the real cameras."""

    def query_devices(self, mask: int | None = None) -> rs.device_list:
        if port.twins():
            return device_list(twin.handle for twin in port.twins() if twin.present)
        return super().query_devices(*() if mask is None else (mask,))

    def query_all_sensors(self) -> list[rs.sensor]:
        if port.twins():
            return [sensor for device in self.query_devices() for sensor in device.query_sensors()]
        return super().query_all_sensors()

    def set_devices_changed_callback(self, callback) -> None:
        if port.twins():
            port.watch(callback)
        super().set_devices_changed_callback(callback)

    @property
    def devices(self) -> rs.device_list:
        return self.query_devices()

    @property
    def sensors(self) -> list[rs.sensor]:
        return self.query_all_sensors()


class device_list(list):
    """Replacement of the library's own, which cannot be constructed in Python."""

    def size(self) -> int:
        return len(self)

    def front(self) -> rs.device:
        return self._end(0)

    def back(self) -> rs.device:
        return self._end(-1)

    def contains(self, device: rs.device) -> bool:
        return device in self

    def __getitem__(self, index):
        try:
            return super().__getitem__(index)
        except IndexError:
            raise IndexError from None  # without a text, as the library's own

    def _end(self, index: int) -> rs.device:
        if not self:
            raise RuntimeError('out of range value for argument "index"')
        return self[index]


def _twin_for(request: rs.config | None) -> TwinDevice | None:
    """Return the twin that `request` names, or the first; None without any.

    Raises:
        RuntimeError: that twin is not present.
    """
    if not port.twins():
        return None
    serial = getattr(request, "requested_serial", None)
    for twin in port.twins():
        if twin.present and serial in (None, twin.serial):
            return twin
    raise RuntimeError(_NO_DEVICE)

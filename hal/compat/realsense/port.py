"""Where twins are plugged in, and what librealsense's own classes do for a twin that its `software_device` cannot."""

from __future__ import annotations

import atexit
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from hal.base.d405 import FrameSource
from hal.compat.realsense.device import SERIAL, TwinDevice
from hal.compat.realsense.library import native as rs

logger = logging.getLogger(__name__)

_twins: list[TwinDevice] = []
_watchers: list[Callable] = []
_hardware_reset, _set_option = rs.device.hardware_reset, rs.options.set_option
_SWITCHES_OFF_AUTO_EXPOSURE = (rs.option.exposure, rs.option.gain)


def plug(source: FrameSource, serial: str = SERIAL) -> TwinDevice:
    """Let librealsense find a twin with these optics, and no other camera than twins, until it is unplugged.

    Raises:
        ValueError: a twin with that serial number is plugged in already.
    """
    if any(twin.serial == serial for twin in _twins):
        raise ValueError(f"a twin with serial number {serial} is plugged in already; give each its own.")
    if not _twins:
        rs.device.hardware_reset, rs.options.set_option = _reset_device, _set_option_as_d405
        atexit.register(_unplug_all)  # no thread may be inside the library when Python ends
    twin = TwinDevice(source, serial)
    twin.on_presence = lambda present: _tell_watchers(twin, present)
    _twins.append(twin)
    twin.start()
    return twin


def unplug(twin: TwinDevice) -> None:
    """Take a twin out again; harmless when it is out. What it streamed falls silent."""
    if twin not in _twins:
        return
    _twins.remove(twin)
    twin.close()
    twin.source.close()
    if not _twins:
        rs.device.hardware_reset, rs.options.set_option = _hardware_reset, _set_option
        _watchers.clear()
        atexit.unregister(_unplug_all)


@contextmanager
def plugged(source: FrameSource, serial: str = SERIAL) -> Iterator[TwinDevice]:
    """Plug a twin in for the length of a `with` block."""
    twin = plug(source, serial)
    try:
        yield twin
    finally:
        unplug(twin)


@contextmanager
def masquerade() -> Iterator[None]:
    """Let `import pyrealsense2` give `hal.compat.realsense` for the length of a `with` block."""
    names = ("pyrealsense2", "pyrealsense2.pyrealsense2")  # older programs import the second
    before = {name: sys.modules.get(name) for name in names}
    sys.modules |= dict.fromkeys(names, sys.modules["hal.compat.realsense"])
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def twins() -> list[TwinDevice]:
    """Return every twin that is plugged in, present on the bus or not."""
    return list(_twins)


def watch(callback: Callable) -> None:
    """Call `callback(event)` when a twin leaves the bus or returns."""
    _watchers.append(callback)


class PresenceEvent:
    """What `set_devices_changed_callback` hands over; the library's own cannot be made from Python."""

    def __init__(self, handle, present: bool) -> None:
        self._handle, self._present = handle, present

    def was_removed(self, device) -> bool:
        return not self._present and _serial(device) == _serial(self._handle)

    def was_added(self, device) -> bool:
        return self._present and _serial(device) == _serial(self._handle)

    def get_new_devices(self) -> list:
        return [self._handle] if self._present else []


def _tell_watchers(twin: TwinDevice, present: bool) -> None:
    for callback in tuple(_watchers):
        callback(PresenceEvent(twin.handle, present))


def _unplug_all() -> None:
    for twin in twins():
        unplug(twin)


def _serial(info) -> str:
    """Return the serial number of a device or sensor, or nothing."""
    return info.get_info(rs.camera_info.serial_number) if info.supports(rs.camera_info.serial_number) else ""


def _reset_device(device) -> None:
    """`device.hardware_reset()`, which a `software_device` does not implement."""
    twin = next((twin for twin in _twins if twin.serial == _serial(device)), None)
    if twin is None:
        _hardware_reset(device)
    else:
        twin.reset()


def _set_option_as_d405(options, option, value: float) -> None:
    """`sensor.set_option()`: on a D400, setting exposure or gain switches auto-exposure off."""
    _set_option(options, option, value)
    is_twin = isinstance(options, rs.sensor) and any(twin.serial == _serial(options) for twin in _twins)
    if is_twin and option in _SWITCHES_OFF_AUTO_EXPOSURE:
        _set_option(options, rs.option.enable_auto_exposure, 0.0)

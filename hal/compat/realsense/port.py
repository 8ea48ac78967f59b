"""Registry of the twins plugged in, and patches of librealsense's classes for gaps of its `software_device`."""

from __future__ import annotations

import atexit
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from hal.base.d405 import FrameSource
from hal.compat.realsense.device import SERIAL, TwinDevice
from hal.compat.realsense.library import native as rs
from hal.masquerade import masquerade_module

_twins: list[TwinDevice] = []
_watchers: list[Callable] = []
_hardware_reset, _set_option = rs.device.hardware_reset, rs.options.set_option
_SWITCHES_OFF_AUTO_EXPOSURE = (rs.option.exposure, rs.option.gain)


def plug(source: FrameSource, serial: str = SERIAL) -> TwinDevice:
    """Make a twin with these optics visible to librealsense, which finds only twins until it is unplugged.

    Raises:
        ValueError: a twin with that serial number is plugged in already.
    """
    if any(twin.serial == serial for twin in _twins):
        raise ValueError(f"D405 twin: serial number {serial} is plugged in already; give each twin its own.")
    if not _twins:
        rs.device.hardware_reset, rs.options.set_option = _reset_device, _set_option_as_d405
        atexit.register(_unplug_all)  # no thread may run inside the library when Python exits
    twin = TwinDevice(source, serial)
    twin.on_presence = lambda present: _notify_watchers(twin, present)
    _twins.append(twin)
    twin.start()
    return twin


def unplug(twin: TwinDevice) -> None:
    """Unplug a twin, which ends its streams. Harmless when unplugged."""
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


def masquerade() -> AbstractContextManager[None]:
    """Make `import pyrealsense2` give `hal.compat.realsense` for the length of a `with` block."""
    names = ("pyrealsense2", "pyrealsense2.pyrealsense2")  # older programs import the second
    return masquerade_module("hal.compat.realsense", *names)


def twins() -> list[TwinDevice]:
    """Return every twin that is plugged in, present on the bus or not."""
    return list(_twins)


def watch(callback: Callable) -> None:
    """Call `callback(event)` when a twin leaves the bus or returns."""
    _watchers.append(callback)


class PresenceEvent:
    """Event of `set_devices_changed_callback`; the library's own cannot be constructed in Python."""

    def __init__(self, handle, present: bool) -> None:
        self._handle, self._present = handle, present

    def was_removed(self, device) -> bool:
        return not self._present and _serial(device) == _serial(self._handle)

    def was_added(self, device) -> bool:
        return self._present and _serial(device) == _serial(self._handle)

    def get_new_devices(self) -> list:
        return [self._handle] if self._present else []


def _notify_watchers(twin: TwinDevice, present: bool) -> None:
    for callback in tuple(_watchers):
        callback(PresenceEvent(twin.handle, present))


def _unplug_all() -> None:
    for twin in twins():
        unplug(twin)


def _serial(info) -> str:
    """Return the serial number of a device or sensor; empty without one."""
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

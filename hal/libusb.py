"""Preload of libusb-1.0, by which `open3d` and `pyrealsense2` can be imported on a machine without it."""

from __future__ import annotations

import ctypes
from functools import cache

from hal.base.errors import SdkMissingError

_SONAME = "libusb-1.0.so.0"


@cache
def preload() -> str:
    """Load libusb-1.0 for wheels that link against it without shipping it; return its path or soname.

    The system's library is preferred, since a real camera's udev rules belong to it; else that of the `libusb-package`
    wheel. Its symbols have to be global: the wheels look them up by soname in the process. Call it before
    `import open3d` or `import pyrealsense2`; further calls do nothing.

    Raises:
        SdkMissingError: there is neither.
    """
    try:
        ctypes.CDLL(_SONAME, mode=ctypes.RTLD_GLOBAL)
    except OSError as missing:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is None:
            raise SdkMissingError(
                f"libusb: {_SONAME} is neither on this machine ({missing}) nor in the libusb-package wheel. "
                "Run `uv sync` or `apt install libusb-1.0-0`."
            ) from missing
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        return str(path)
    return _SONAME

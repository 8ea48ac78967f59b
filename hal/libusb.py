"""Lets `open3d` and `pyrealsense2` be imported on a machine without libusb-1.0."""

from __future__ import annotations

import ctypes
from functools import cache

_SONAME = "libusb-1.0.so.0"


@cache
def preload() -> str:
    """Load libusb-1.0 for those who link against it without bringing it; return where it came from.

    The system's is taken where there is one, since a real camera wants the one its udev rules were made for; else
    that of the `libusb-package` wheel. Its names have to be global: the wheels that need it look them up by soname
    in the process. Call it before `import open3d` or `import pyrealsense2`; more calls do nothing.

    Raises:
        ImportError: there is neither.
    """
    try:
        ctypes.CDLL(_SONAME, mode=ctypes.RTLD_GLOBAL)
    except OSError as missing:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is None:
            raise ImportError(
                f"there is no {_SONAME} on this machine ({missing}) and none in the libusb-package wheel; "
                "run `uv sync` or `apt install libusb-1.0-0`."
            ) from missing
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        return str(path)
    return _SONAME

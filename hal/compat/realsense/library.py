"""librealsense's own Python module, or an error with the remedy where it is missing."""

from __future__ import annotations

import platform as _platform
import sys as _sys

from hal.base.errors import SdkMissingError as _SdkMissingError
from hal.libusb import preload as _preload

try:
    _preload()
    import pyrealsense2 as native  # noqa: F401 - the unchanged module, for the twin
    from pyrealsense2 import *  # noqa: F403 - re-exported under the same names
    from pyrealsense2 import __full_version__, __version__  # noqa: F401 - re-exported too
except ImportError as _error:
    raise _SdkMissingError(
        f"librealsense's Python module cannot be imported ({_error}) on {_platform.system()} {_platform.machine()} "
        f"with Python {_platform.python_version()}. PyPI has its wheels for x86_64 Linux and Windows only: there, "
        "run `uv sync`. Elsewhere build librealsense 2.56 or newer with -DBUILD_PYTHON_BINDINGS=ON "
        f"-DPYTHON_EXECUTABLE={_sys.executable} and install it, or keep the camera on an x86_64 PC, run `./z1 hal` "
        "there and connect over Zenoh. The twin in one process (`--sim`) needs none of it."
    ) from _error

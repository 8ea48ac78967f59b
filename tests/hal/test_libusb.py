"""Modules that link against libusb can be imported after the preload."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec

import pytest

from hal import libusb

pytestmark = pytest.mark.integration


def test_preloading_twice_gives_the_same_library() -> None:
    assert libusb.preload() == libusb.preload()
    assert "libusb-1.0" in libusb.preload()


@pytest.mark.parametrize("module", ["open3d", "pyrealsense2"])
def test_a_module_that_needs_libusb_is_imported_after_the_preload(module: str) -> None:
    if module == "pyrealsense2" and find_spec(module) is None:
        pytest.skip("pyrealsense2 has no wheel for this platform")
    code = f"from hal.libusb import preload; preload(); import {module}; print({module}.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == module, done.stderr

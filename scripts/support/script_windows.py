"""Replacement of OpenCV's windows where it has none: their last images are written to files."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hal.base.clock import Clock

_ESC = 27  # with q, the key by which OpenCV's and librealsense's examples end
_NO_KEY = -1  # OpenCV's own value
_SILENT = ("namedWindow", "resizeWindow", "moveWindow", "setWindowTitle", "setWindowProperty", "setMouseCallback")
_SILENT += ("createTrackbar", "setTrackbarPos", "destroyWindow", "destroyAllWindows", "startWindowThread")


class Windows:
    """Images shown by a script, and simulated key presses.

    Args:
        clock: clock of `waitKey`.
        frames: number of images after which Esc and q are pressed in turn; 0 = never.
    """

    def __init__(self, clock: Clock, frames: int) -> None:
        self._clock, self._frames = clock, frames
        self._images: dict[str, np.ndarray] = {}
        self._shown = self._keys = 0

    def show(self, window: str, image: Any) -> None:
        """Keep a copy of the image for `save`."""
        self._images[window] = np.array(image)
        self._shown += 1

    def wait_key(self, delay_ms: int = 0) -> int:
        """Wait as OpenCV does and return a key's code, or −1."""
        # OpenCV waits for ever at 0; here no operator could press a key.
        self._clock.sleep_until(self._clock.now_s() + 1e-3 * max(delay_ms, 1))
        if not self._frames or self._shown < self._frames:
            return _NO_KEY
        self._keys += 1
        return _ESC if self._keys % 2 else ord("q")

    def save(self, folder: Path) -> list[Path]:
        """Write the last image of each window and return the files."""
        files = []
        for window, image in self._images.items():
            folder.mkdir(parents=True, exist_ok=True)
            files.append(folder / f"{re.sub(r'[^A-Za-z0-9]+', '_', window).strip('_') or 'window'}.png")
            scaled = 255.0 * image if image.dtype.kind == "f" else image  # as imshow() does
            cv2.imwrite(str(files[-1]), scaled.astype(np.uint16 if image.dtype == np.uint16 else np.uint8))
        return files


@contextmanager
def windows_as_files(folder: Path, clock: Clock, frames: int) -> Iterator[Windows | None]:
    """Replace the windows of an OpenCV built without any, and write them to `folder` at the end."""
    if not re.search(r"GUI:\s+NONE", cv2.getBuildInformation()):  # else not opencv-python-headless: real windows
        yield None
        return
    windows = Windows(clock, frames)
    ours: dict[str, Any] = dict.fromkeys(_SILENT, lambda *args, **kwargs: None)
    ours |= {"imshow": windows.show, "waitKey": windows.wait_key, "waitKeyEx": windows.wait_key}
    # 1.0 = visible: scripts that poll the property would take any other value for a closed window.
    ours |= {"pollKey": lambda: windows.wait_key(0), "getWindowProperty": lambda *args: 1.0}
    before = {name: getattr(cv2, name) for name in ours if hasattr(cv2, name)}  # a build without windows may lack some
    for name, function in ours.items():
        setattr(cv2, name, function)
    try:
        yield windows
    finally:
        for name, function in before.items():
            setattr(cv2, name, function)
        for file in windows.save(folder):
            print(f"its window is in {file}", file=sys.stderr)

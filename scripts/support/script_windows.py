"""OpenCV's windows where it has none: their last pictures are written to files."""

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

_ESC = 27
_NO_KEY = -1
_SILENT = ("namedWindow", "resizeWindow", "moveWindow", "setWindowTitle", "setWindowProperty", "setMouseCallback")
_SILENT += ("createTrackbar", "setTrackbarPos", "destroyWindow", "destroyAllWindows", "startWindowThread")


class Windows:
    """What a script shows, and the keys it is told were pressed.

    Args:
        clock: by which `waitKey` waits.
        frames: after so many pictures it is told Esc and q in turn; 0 = never.
    """

    def __init__(self, clock: Clock, frames: int) -> None:
        self._clock, self._frames = clock, frames
        self._pictures: dict[str, np.ndarray] = {}
        self._shown = self._asked = 0

    def show(self, window: str, picture: Any) -> None:
        """Keep a copy of the picture for `save`."""
        self._pictures[window] = np.array(picture)
        self._shown += 1

    def wait_key(self, delay_ms: int = 0) -> int:
        """Wait as OpenCV does and return a key's code, or −1."""
        self._clock.sleep_until(self._clock.now_s() + 1e-3 * max(delay_ms, 1))
        if not self._frames or self._shown < self._frames:
            return _NO_KEY
        self._asked += 1
        return _ESC if self._asked % 2 else ord("q")

    def save(self, folder: Path) -> list[Path]:
        """Write the last picture of each window and return the files."""
        files = []
        for window, picture in self._pictures.items():
            folder.mkdir(parents=True, exist_ok=True)
            files.append(folder / f"{re.sub(r'[^A-Za-z0-9]+', '_', window).strip('_') or 'window'}.png")
            scaled = 255.0 * picture if picture.dtype.kind == "f" else picture  # as imshow() does
            cv2.imwrite(str(files[-1]), scaled.astype(np.uint16 if picture.dtype == np.uint16 else np.uint8))
        return files


@contextmanager
def windows_as_files(folder: Path, clock: Clock, frames: int) -> Iterator[Windows | None]:
    """Give an OpenCV that was built without windows some that end up in `folder`; leave any other alone."""
    if not re.search(r"GUI:\s+NONE", cv2.getBuildInformation()):
        yield None
        return
    windows = Windows(clock, frames)
    ours: dict[str, Any] = dict.fromkeys(_SILENT, lambda *args, **kwargs: None)
    ours |= {"imshow": windows.show, "waitKey": windows.wait_key, "waitKeyEx": windows.wait_key}
    ours |= {"pollKey": lambda: windows.wait_key(0), "getWindowProperty": lambda *args: 1.0}
    before = {name: getattr(cv2, name) for name in ours if hasattr(cv2, name)}
    for name, function in ours.items():
        setattr(cv2, name, function)
    try:
        yield windows
    finally:
        for name, function in before.items():
            setattr(cv2, name, function)
        for file in windows.save(folder):
            print(f"its window is in {file}", file=sys.stderr)

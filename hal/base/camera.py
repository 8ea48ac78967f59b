"""What a depth camera is to the rest of the system."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from hal.base.messages import Intrinsics, RgbdFrame


@runtime_checkable
class Camera(Protocol):
    """Colour and depth of one instant, in one message."""

    def connect(self) -> None:
        """Open the device and wait until it delivers. A failed connect leaves nothing open.

        Raises:
            HalTimeoutError: no frame arrives.
        """
        ...

    def disconnect(self) -> None:
        """Close the device. Harmless when not connected."""
        ...

    @property
    def intrinsics(self) -> Intrinsics:
        """Of both images of every frame.

        Raises:
            NotConnectedError: before `connect()`.
        """
        ...

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame exposed after this call began.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: none came within `timeout_s` [s].
        """
        ...

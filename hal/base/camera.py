"""Contract of a depth camera."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from hal.base.messages import ArmState, Intrinsics, RgbdFrame


@runtime_checkable
class Camera(Protocol):
    """A camera of colour and depth, both of one instant, in one message."""

    def connect(self) -> None:
        """Open the device and wait for its first frame. A failed connect leaves nothing open.

        Raises:
            HalTimeoutError: no frame arrives.
        """
        ...

    def disconnect(self) -> None:
        """Close the device. No effect when not connected."""
        ...

    @property
    def intrinsics(self) -> Intrinsics:
        """Pinhole of both images of every frame.

        Raises:
            NotConnectedError: before `connect()`.
        """
        ...

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame exposed after this call began.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: no frame arrived within `timeout_s` [s].
        """
        ...


@runtime_checkable
class ArmFollower(Protocol):
    """A simulated camera that renders an arm which another device moves."""

    def follow(self, read_state: Callable[[], ArmState]) -> None:
        """Render the joints that `read_state` returns, from the next frame on."""
        ...

"""The camera of a robot that runs without one: connected at once, and every request for a frame is an error."""

from __future__ import annotations

from hal.base.clock import Clock
from hal.base.errors import CameraError
from hal.base.messages import Intrinsics, RgbdFrame

_ONE_PIXEL = Intrinsics(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)  # buffers for frames take no space


class NoCamera:
    """Absent camera (`hal.base.camera.Camera`) of an arm that runs alone.

    Args:
        clock: of other cameras; unused.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        del clock

    def connect(self) -> None:
        """Do nothing: there is no device."""

    def disconnect(self) -> None:
        """Do nothing."""

    @property
    def intrinsics(self) -> Intrinsics:
        """A single pixel."""
        return _ONE_PIXEL

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        """Raise the error of a camera that is not there.

        Raises:
            CameraError: always (`no_camera`).
        """
        raise CameraError(
            "camera: this robot runs without a camera, so that there are no frames. Start the HAL without "
            "--no-camera, or with another --camera.",
            code="no_camera",
        )

"""Shows what the camera sees while the arm moves; a thread of its own, which nobody waits for."""

from __future__ import annotations

import logging
import threading

import numpy as np

from hal.base import z1
from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.errors import HalError
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.visualization.rerun_logger import RerunLogger

_LOG = logging.getLogger(__name__)
_PATIENCE_S = 1.0


class LiveView:
    """Hands frames to the inspector, with the camera's pose at that moment; few, since each costs the HAL a picture.

    For devices that live by the wall clock; in lock-step, waiting for a frame would move time.

    Args:
        camera: connected; others may wait for its frames too.
        arm: connected.
        inspector: gets the frames.
        T_flange_camera: (4, 4) hand-eye transform.
        rate_hz: most frames a second.
    """

    def __init__(
        self,
        camera: Camera,
        arm: Arm,
        inspector: RerunLogger,
        T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
        *,
        rate_hz: float = 4.0,
    ) -> None:
        self._camera = camera
        self._arm = arm
        self._inspector = inspector
        self._T_flange_camera = T_flange_camera
        self._kinematics = Kinematics()
        self._period_s = 1.0 / rate_hz
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frame tap", daemon=True)

    def __enter__(self) -> LiveView:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.wait(self._period_s):
            try:
                frame = self._camera.wait_for_frame(_PATIENCE_S)
                q = self._arm.read_state().q[: z1.N_ARM]
            except HalError as err:
                _LOG.warning("no more frames are shown: %s", err)
                return
            self._inspector.log_frame(frame, self._kinematics.flange(q) @ self._T_flange_camera)

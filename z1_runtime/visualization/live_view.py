"""Frames of the wrist camera in the recording while the arm moves, from a thread of their own."""

from __future__ import annotations

import logging
import threading

import numpy as np

from hal.base import z1
from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.errors import HalError
from hal.base.z1_model import ForwardKinematics
from z1_runtime.visualization.rerun_logger import RerunLogger

_LOG = logging.getLogger(__name__)
_FRAME_TIMEOUT_S = 1.0


class LiveView:
    """Thread that logs frames with the camera's pose at that moment, at a low rate: the HAL encodes each of them.

    For devices on the wall clock; in lock-step, waiting for a frame would move time.

    Args:
        camera: connected; other threads may wait for its frames too.
        arm: connected.
        logger: receives the frames.
        T_flange_camera: (4, 4) hand-eye transform.
        rate_hz: highest rate of frames [Hz].
    """

    def __init__(
        self,
        camera: Camera,
        arm: Arm,
        logger: RerunLogger,
        T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
        *,
        rate_hz: float = 4.0,
    ) -> None:
        self._camera = camera
        self._arm = arm
        self._logger = logger
        self._T_flange_camera = T_flange_camera
        # Its own: such an object belongs to one thread
        self._kinematics = ForwardKinematics()
        self._period_s = 1.0 / rate_hz
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)

    def __enter__(self) -> LiveView:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()  # before the devices disconnect

    def _run(self) -> None:
        while not self._closing.wait(self._period_s):
            try:
                frame = self._camera.wait_for_frame(_FRAME_TIMEOUT_S)
                q = self._arm.read_state().q[: z1.N_ARM]
            except HalError as err:
                _LOG.warning("the live view ends: %s", err)
                return
            self._logger.log_frame(frame, self._kinematics.flange(q) @ self._T_flange_camera)

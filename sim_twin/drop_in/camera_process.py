"""The twin's optics in a process of their own: software rendering holds no lock that the arm waits for."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection

import mujoco
import numpy as np

from hal.base.clock import Clock, WallClock
from hal.base.d405 import MIN_Z_M, CaptureRequest, D405Calibration, Exposure
from sim_twin.drop_in.child_process import ChildProcess
from sim_twin.drop_in.process import WireProcess, load_model
from sim_twin.drop_in.shared_memory import SharedWorld, make_memory, map_memory
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import SceneView

_IMAGES = ("depth", "colour", "left", "right")
_MAX_PIXELS = max(width * height for width, height in MIN_Z_M)
_FRAME = np.dtype(
    [(name, "<u2" if name == "depth" else "u1", (_MAX_PIXELS * (1 if name == "depth" else 3),)) for name in _IMAGES]
)


class RemoteSource:
    """`hal.base.d405.FrameSource` of a world in another process, rendered in a third, by the wall clock.

    Args:
        twin: the scene.
        calibration: optics of the unit; by default figures of real ones.
    """

    lockstep = False

    def __init__(self, twin: WireProcess, calibration: D405Calibration | None = None) -> None:
        self.clock: Clock = WallClock()
        self.calibration = calibration if calibration is not None else D405Calibration()
        self.attached = True
        """Whether the cable is plugged in; writable, to inject a fault."""
        self.world = twin
        self._child: ChildProcess | None = None
        self._memory = make_memory(_FRAME.itemsize)
        self._frame = map_memory(self._memory, _FRAME)

    def start(self) -> None:
        """Start the process, and wait until it can render. Harmless when started.

        Raises:
            HalError: it could not start; the message is its own.
        """
        if self._child is not None:
            return
        twin = self.world
        files = (twin.memory, twin.model_file, self._memory)
        child = ChildProcess(
            "sim_twin.drop_in.camera_process:serve", (twin.config, self.calibration, files), files, "the twin's camera"
        )
        child.wait_ready()
        self._child = child

    def expose(self, request: CaptureRequest) -> Exposure:
        """Return an exposure of the present scene.

        Raises:
            CameraError: the requested renderer is not available.
            HalError: one of the two processes has ended.
        """
        self.start()
        assert self._child is not None
        stamp_s, present = self._child.request(request)
        images = {name: _image(self._frame, name, request).copy() for name in present}
        return Exposure(number=request.number, stamp_s=stamp_s, **images)

    def warm_up(self, width: int = 848, height: int = 480) -> None:
        """Start the process and render once, so that the first frame is as fast as the others."""
        self.expose(CaptureRequest(number=0, width=width, height=height, depth=True, colour=True))

    def reset(self) -> None:
        """Do nothing: these optics have no state to reset."""

    def close(self) -> None:
        """End the process until the next `expose`."""
        child, self._child = self._child, None
        if child is not None:
            child.close()

    def __del__(self) -> None:
        os.close(self._memory)


class _SharedView(SceneView):
    """Scene in the shared memory that its world publishes into."""

    def __init__(self, config: SceneConfig, shared: SharedWorld, model: mujoco.MjModel) -> None:
        super().__init__(config)
        self._shared, self._model = shared, model
        self.start_height_m = shared.start_height_m

    @property
    def model(self) -> mujoco.MjModel:
        return self._model

    def poses(self) -> tuple[float, np.ndarray]:
        return self._shared.read()


def serve(
    connection: Connection, scene: SceneConfig, calibration: D405Calibration, files: tuple[int, int, int]
) -> None:
    """Run the third process: render on request until the connection is closed.

    Raises:
        CameraError: the requested renderer is not available.
    """
    from sim_twin.drop_in.realsense_source import TwinSource  # only this process loads rendering and noise

    world, model, frames = files
    view, frame = _SharedView(scene, SharedWorld(world), load_model(model)), map_memory(frames, _FRAME)
    with TwinSource(view, WallClock(), calibration=calibration, low_priority=False) as source:
        connection.send(None)
        while True:
            request = connection.recv()
            exposure = source.expose(request)
            present = [name for name in _IMAGES if getattr(exposure, name) is not None]
            for name in present:
                _image(frame, name, request)[...] = getattr(exposure, name)
            connection.send((exposure.stamp_s, present))


def _image(frame: np.ndarray, name: str, request: CaptureRequest) -> np.ndarray:
    """Return the image `name` (H, W) or (H, W, 3) inside the shared frame."""
    shape = (request.height, request.width) if name == "depth" else (request.height, request.width, 3)
    return frame[name][: int(np.prod(shape))].reshape(shape)

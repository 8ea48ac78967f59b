"""Rig `wire-sim`: one simulated world behind both real drivers, the arm's on UDP, the camera's on librealsense.

Three processes, as on a robot: the drivers in this one, controller and physics in the second, the camera's optics in
the third. In a single one, a rendering thread at low priority would hold the interpreter's lock that the arm needs.
"""

from __future__ import annotations

import socket
from dataclasses import replace
from typing import Any

from hal.backends.d405.camera import D405Camera
from hal.backends.d405.session import D405CameraConfig
from hal.backends.z1.arm import Z1Arm
from hal.backends.z1.config import Z1ArmConfig, Z1Mode
from hal.base.clock import Clock, WallClock
from hal.base.errors import HalError
from hal.base.messages import ArmState
from hal.rig import Rig
from sim_twin.drop_in.camera_process import RemoteSource
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.process import WireProcess
from sim_twin.model.scene import SceneConfig

_LOOPBACK = "127.0.0.1"
_EXIT_CODE_WAIT_S = 0.2  # between the last answer and the exit code of a process that ends [s]


class WireSimArm(Z1Arm):
    """Real driver of the Z1 that starts the twin's controller when it is connected.

    Args:
        twin: process of the controller.
        clock: the wall clock.
        mode: command mode.
    """

    def __init__(self, twin: WireProcess, clock: Clock, mode: Z1Mode = Z1Mode.TRACKING) -> None:
        w = twin.wire
        config = Z1ArmConfig(
            host=w.host, command_port=w.command_port, local_host=w.client_host, state_port=w.state_port, mode=mode
        )
        super().__init__(clock, config)
        self.twin = twin

    def connect(self) -> None:
        self.twin.start()
        super().connect()

    def read_state(self) -> ArmState:
        try:
            return super().read_state()
        except HalError as error:
            if ended := self.twin.exit_reason(_EXIT_CODE_WAIT_S):
                raise HalError(ended, code="process_ended") from error
            raise


class WireSimCamera(D405Camera):
    """Real driver of the D405 that starts the twin's optics when it is connected.

    Args:
        twin: process with the scene.
        config: streams.
    """

    def __init__(self, twin: WireProcess, config: D405CameraConfig | None = None) -> None:
        config = replace(config if config is not None else D405CameraConfig(), serial=twin.config.camera_serial())
        self.optics = RemoteSource(twin)
        super().__init__(config, source=self.optics)

    def connect(self) -> None:
        self.optics.warm_up(self.config.width, self.config.height)  # takes seconds, longer than the timeout of a camera
        super().connect()


def make_wire_sim_rig(scene: SceneConfig | None = None, mode: Z1Mode = Z1Mode.TRACKING, **_: Any) -> Rig:
    """Return both real drivers on one new world by the wall clock, on free loopback ports, not yet connected.

    Args:
        scene: the scene; None = the default one.
        mode: command mode of the arm.
        **_: options of other rigs.
    """
    clock = WallClock()
    command_port, state_port = free_ports()
    wire = WireConfig(host=_LOOPBACK, command_port=command_port, client_host=_LOOPBACK, state_port=state_port)
    twin = WireProcess(scene if scene is not None else SceneConfig(), wire)
    arm = WireSimArm(twin, clock, mode)
    return Rig(arm=arm, camera=WireSimCamera(twin), clock=clock, give_back=arm.give_back, world=twin)


def free_ports() -> tuple[int, int]:
    """Return two free UDP ports of the loopback interface."""
    # Both are open at once, or the system might give the same port twice
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as other:
        one.bind((_LOOPBACK, 0))
        other.bind((_LOOPBACK, 0))
        return one.getsockname()[1], other.getsockname()[1]

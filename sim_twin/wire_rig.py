"""The rig `wire-sim`: one simulated world behind both real drivers, the arm's on UDP, the camera's on librealsense."""

from __future__ import annotations

import socket
from typing import Any

from hal.backends.z1_arm import Z1Arm
from hal.backends.z1_config import Z1ArmConfig, Z1Mode
from hal.clock import Clock, WallClock
from hal.rig import Rig
from sim_twin.controlled_world import ControlledWorld
from sim_twin.realsense_source import make_camera
from sim_twin.scene import SceneConfig
from sim_twin.wire_server import WireConfig, WireServer
from sim_twin.world import World

_LOOPBACK = "127.0.0.1"


class WiredArm(Z1Arm):
    """The real driver, with the controller that it talks to: that one runs while this one is connected.

    Args:
        server: the controller.
        clock: the wall's.
        mode: how the arm is commanded.
    """

    def __init__(self, server: WireServer, clock: Clock, mode: Z1Mode = Z1Mode.TRACKING) -> None:
        c = server.config
        config = Z1ArmConfig(
            host=c.host, command_port=c.command_port, local_host=c.client_host, state_port=c.state_port, mode=mode
        )
        super().__init__(clock, config)
        self.server = server

    def connect(self) -> None:
        self.server.start()
        try:
            super().connect()
        except BaseException:
            self.server.stop()
            raise

    def disconnect(self) -> None:
        super().disconnect()
        self.server.stop()


def make_wire_rig(scene: SceneConfig | None = None, mode: Z1Mode = Z1Mode.TRACKING, **_: Any) -> Rig:
    """Return both real drivers on one new world by the wall clock, on free loopback ports, not yet connected.

    Args:
        scene: what stands on the table; the default scene if None.
        mode: how the arm is commanded.
        **_: options of other rigs.
    """
    clock = WallClock()
    world = World(scene if scene is not None else SceneConfig())
    command_port, state_port = free_ports()
    config = WireConfig(host=_LOOPBACK, command_port=command_port, client_host=_LOOPBACK, state_port=state_port)
    server = WireServer(ControlledWorld(world), config, clock)
    return Rig(arm=WiredArm(server, clock, mode), camera=make_camera(world, clock), clock=clock, world=world)


def free_ports() -> tuple[int, int]:
    """Return two UDP ports of the loopback that nobody has at this moment."""
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as other:
        one.bind((_LOOPBACK, 0))
        other.bind((_LOOPBACK, 0))
        return one.getsockname()[1], other.getsockname()[1]

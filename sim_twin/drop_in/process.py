"""World and controller in a process of their own, as on a robot: no load and no lock of another process delays them."""

from __future__ import annotations

import logging
import os
import pickle
from functools import cached_property
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from sim_twin.drop_in.child_process import ChildProcess
from sim_twin.drop_in.config import WireConfig
from sim_twin.drop_in.shared_memory import SharedWorld, make_memory
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import SceneView

if TYPE_CHECKING:
    from sim_twin.drop_in.udp_server import ArmEndpoint

_POLL_S = 0.05


class WireProcess(SceneView):
    """A twin behind the vendor's protocol in another process, and a view of its scene in this one.

    It starts with its first use and runs, as a real controller does, with or without a client, until `close`, the last
    reference to this, or the end of this process.

    Args:
        config: the scene.
        wire: part of the robot that the twin replaces, and its addresses.
        q_start: (7,) initial joints of the arm [rad]; by default home.
    """

    def __init__(self, config: SceneConfig, wire: WireConfig, q_start: np.ndarray | None = None) -> None:
        super().__init__(config)
        self.wire = wire
        self._q_start = q_start
        self._memory = make_memory(SharedWorld.SIZE)
        self._model_file = make_memory(0)
        self._shared = SharedWorld(self._memory)
        self._child: ChildProcess | None = None
        self.error: np.ndarray = self._shared.injected_faults["error"]
        """(7, 2) `MotorError` bits; writable, to inject a fault."""
        self.link: np.ndarray = self._shared.injected_faults["link"]
        """(7, 2) `MotorLink`; writable, to inject a fault."""

    def start(self) -> None:
        """Start the process, and wait until it answers. Harmless when started.

        Raises:
            LeaseError: another program has its port.
            HalError: it could not start; the message is its own.
        """
        if self._child is not None:
            return
        logger = logging.getLogger(__name__)
        files = (self._memory, self._model_file)
        arguments = (self.config, self.wire, self._q_start, files)
        child = ChildProcess("sim_twin.drop_in.process:serve", arguments, files, f"the twin's {self.wire.depth}")
        child.wait_ready()
        logger.info("the twin's %s runs in process %d", self.wire.depth, child.pid)
        self._child = child

    def close(self) -> None:
        """End the process. Harmless when not started."""
        child, self._child = self._child, None
        if child is not None:
            child.close()

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._child is not None and self._child.running

    @property
    def silent(self) -> bool:
        """Whether the motor board is silent; writable, to inject a fault."""
        return bool(self._shared.injected_faults["silent"])

    @silent.setter
    def silent(self, silent: bool) -> None:
        self._shared.injected_faults["silent"] = silent

    def exit_reason(self, timeout_s: float = 0.0) -> str:
        """Return how the process ended; empty while it runs, after waiting `timeout_s` [s], or when not started."""
        return "" if self._child is None else self._child.exit_reason(timeout_s)

    def statistics(self) -> dict[str, Any]:
        """Return the server's statistics: `answers`, `invalid_datagrams`, `invalid_reason`.

        Raises:
            HalError: the process has ended.
        """
        self.start()
        assert self._child is not None
        return self._child.request("statistics")

    # --- The scene --------------------------------------------------------------------------------------------------

    @property
    def start_height_m(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride] - read only here
        """Initial height of the object's lowest point [m]."""
        self.start()
        return self._shared.start_height_m

    @cached_property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model, from the other process: compiling it takes seconds."""
        return load_model(self.model_file)

    @property
    def model_file(self) -> int:
        """Descriptor of the file with the pickled model, for a third process."""
        self.start()
        return self._model_file

    @property
    def memory(self) -> int:
        """Descriptor of the `SharedWorld`, for a third process."""
        self.start()
        return self._memory

    def poses(self) -> tuple[float, np.ndarray]:
        self.start()
        return self._shared.read()

    def __del__(self) -> None:
        for fd in (self._memory, self._model_file):
            os.close(fd)


def load_model(fd: int) -> mujoco.MjModel:
    """Return the model in the file behind `fd`."""
    size = os.fstat(fd).st_size
    # Not `read`: processes that inherited a descriptor share its position
    return pickle.loads(os.pread(fd, size, 0))


def make_twin(
    scene: SceneConfig, wire: WireConfig, q_start: np.ndarray | None = None, injected_faults: np.ndarray | None = None
) -> ArmEndpoint:
    """Return a new world behind the protocol of `wire`.

    Args:
        scene: the scene.
        wire: the depth at which the twin replaces the robot.
        q_start: (7,) initial joints of the arm [rad]; by default home.
        injected_faults: a record of `sim_twin.controller.fault_injection.INJECTED_FAULTS`, written from outside.
    """
    from sim_twin.model.world import World  # only the other process loads physics and controller

    world = World(scene, q_start)
    if wire.depth == "board":
        from sim_twin.controller.motor_board import MotorBoard

        return MotorBoard(world, injected_faults)
    from sim_twin.controller.controlled_world import ControlledWorld

    return ControlledWorld(world, injected_faults)


def serve(
    connection: Connection, scene: SceneConfig, wire: WireConfig, q_start: np.ndarray | None, files: tuple[int, int]
) -> None:
    """Run the other process: serve until the connection is closed.

    Raises:
        LeaseError: another program has the port.
        Exception: the failure that ended the server's thread.
    """
    from sim_twin.drop_in.udp_server import WireServer

    logging.basicConfig(level=logging.WARNING, format="twin: %(message)s")
    memory, model = files
    shared = SharedWorld(memory)
    twin = make_twin(scene, wire, q_start, shared.injected_faults)
    world = twin.world
    shared.start_height_m = world.start_height_m
    # Before readiness is reported below: the parent may read the poses and the model at once
    shared.publish(*world.poses())
    with open(model, "wb", closefd=False) as file:
        pickle.dump(world.model, file)
    with WireServer(twin, wire, on_step=lambda: shared.publish(*world.poses())) as server:
        connection.send(None)
        while server.running:
            if connection.poll(_POLL_S):
                connection.recv()
                connection.send(
                    {
                        "answers": server.answers,
                        "invalid_datagrams": twin.invalid_datagrams,
                        "invalid_reason": twin.invalid_reason,
                    }
                )

"""World and controller in a process of their own, as a robot's are: nobody's load and nobody's lock slows them down."""

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
from sim_twin.model.scene_view import SceneView

if TYPE_CHECKING:
    from sim_twin.drop_in.udp_server import WiredWorld

_LOOK_S = 0.05


class WireProcess(SceneView):
    """A twin behind a wire in another process, and its scene as this one sees it.

    It starts with its first use and lives, as a real controller does, whether anybody talks to it or not, until
    `close`, the last reference to this, or the end of this process.

    Args:
        config: what is_stable where.
        wire: where it listens.
        q_start: (7,) where the arm starts [rad]; by default at home.
    """

    def __init__(self, config: SceneConfig, wire: WireConfig, q_start: np.ndarray | None = None) -> None:
        super().__init__(config)
        self.wire = wire
        self._q_start = q_start
        self._memory = make_memory(SharedWorld.SIZE)
        self._model_file = make_memory(0)
        self._shared = SharedWorld(self._memory)
        self._child: ChildProcess | None = None
        self.error: np.ndarray = self._shared.ailments["error"]
        """(7, 2) `MotorError` bits; set them to break a motor."""
        self.link: np.ndarray = self._shared.ailments["link"]
        """(7, 2) `MotorLink`; the same."""

    def start(self) -> None:
        """Let it begin, and wait until it answers. Harmless when it has begun.

        Raises:
            LeaseError: another program has its port.
            HalError: it could not begin; the message is its own.
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
        """End it. Harmless when it has not begun."""
        child, self._child = self._child, None
        if child is not None:
            child.close()

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._child is not None and self._child.alive

    @property
    def silent(self) -> bool:
        """Whether its board is dead; may be set."""
        return bool(self._shared.ailments["silent"])

    @silent.setter
    def silent(self, silent: bool) -> None:
        self._shared.ailments["silent"] = silent

    def why_it_ended(self, timeout_s: float = 0.0) -> str:
        """Return how it ended; empty while it runs, for `timeout_s` [s] longer, or when it has not begun."""
        return "" if self._child is None else self._child.why_it_ended(timeout_s)

    def account(self) -> dict[str, Any]:
        """Return what it has done: `answers`, `refused`, `last_refusal`.

        Raises:
            HalError: it has ended.
        """
        self.start()
        assert self._child is not None
        return self._child.ask("account")

    # --- The scene --------------------------------------------------------------------------------------------------

    @property
    def start_height_m(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride] - read only here
        """Where the object's lowest point was at the start [m]."""
        self.start()
        return self._shared.start_height_m

    @cached_property
    def model(self) -> mujoco.MjModel:
        """What MuJoCo computes with: the other process's model, which took seconds to make."""
        return load_model(self.model_file)

    @property
    def model_file(self) -> int:
        """Descriptor of the file with the pickled model, for yet another process."""
        self.start()
        return self._model_file

    @property
    def memory(self) -> int:
        """Descriptor of the `SharedWorld`, for yet another process."""
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
    return pickle.loads(os.pread(fd, size, 0))


def make_twin(
    scene: SceneConfig, wire: WireConfig, q_start: np.ndarray | None = None, ailments: np.ndarray | None = None
) -> WiredWorld:
    """Return a new world behind what `wire` says it is.

    Args:
        scene: what is_stable where.
        wire: which depth.
        q_start: (7,) where the arm starts [rad]; by default at home.
        ailments: a record of `sim_twin.controller.fault_injection.AILMENTS`, written into from outside.
    """
    from sim_twin.model.world import World  # physics and controller are the other process's to load

    world = World(scene, q_start)
    if wire.depth == "board":
        from sim_twin.controller.motor_board import ArmBoard

        return ArmBoard(world, ailments)
    from sim_twin.controller.controlled_world import ControlledWorld

    return ControlledWorld(world, ailments)


def serve(
    connection: Connection, scene: SceneConfig, wire: WireConfig, q_start: np.ndarray | None, files: tuple[int, int]
) -> None:
    """Be the other process: serve until the connection is closed.

    Raises:
        LeaseError: another program has the port.
        Exception: whatever ended the server's thread.
    """
    from sim_twin.drop_in.udp_server import WireServer

    logging.basicConfig(level=logging.WARNING, format="twin: %(message)s")
    memory, model = files
    shared = SharedWorld(memory)
    twin = make_twin(scene, wire, q_start, shared.ailments)
    world = twin.world
    shared.start_height_m = world.start_height_m
    shared.publish(*world.poses())
    with open(model, "wb", closefd=False) as file:
        pickle.dump(world.model, file)
    with WireServer(twin, wire, on_step=lambda: shared.publish(*world.poses())) as server:
        connection.send(None)
        while server.alive:
            if connection.poll(_LOOK_S):
                connection.recv()
                connection.send({"answers": server.answers, "refused": twin.refused, "last_refusal": twin.last_refusal})

"""The twin's Z1 in place of the vendor's controller: programs for a real Z1 drive it over UDP.

    ./z1 twin wire                                             answers at 127.0.0.1:8071, to port 8072
    ./z1 twin wire --command-port 8073 --state-port 8074       a second arm

Stop it with Ctrl-C.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from threading import Event
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hal.process import stop_on_signals
from scripts.run_hal import READY
from sim_twin.wire_server import WireConfig

if TYPE_CHECKING:
    from sim_twin.wire_server import WireServer

_LOOK_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Config:
    """Where it answers, how the arm lies, and what stands on the table."""

    wire: Annotated[WireConfig, tyro.conf.arg(name="")] = field(default_factory=WireConfig)
    """Where it answers."""
    start: Literal["startFlat", "home"] = "startFlat"
    """How the arm lies until the first command comes: folded, as the real one is switched on, or looking ahead."""
    object: str = "bottle"
    """What stands on the table: bottle, box or cylinder."""
    distance_m: float = 0.48
    """How far in front of the base [m]."""
    lateral_m: float = 0.0
    """How far to the left [m]."""
    pitch_deg: float = 0.0
    """Lean about the base's y axis [°]."""


def main(arguments: list[str]) -> int:
    """Answer until told to stop."""
    config = tyro.cli(Config, prog="z1 twin wire", description=__doc__, args=arguments)
    stop_event = Event()
    stop_on_signals(stop_event)
    with make_server(config) as server:
        wire = config.wire
        print(f"the twin's Z1 listens on {wire.host}:{wire.command_port} and answers to", end=" ")
        print(f"{wire.client_host}:{wire.state_port}; Ctrl-C ends it.\n{READY}", flush=True)
        while not stop_event.wait(_LOOK_S) and server.alive:
            pass
    twin = server.twin
    why = f" (the last one: {twin.last_refusal})" if twin.refused else ""
    print(f"{server.answers} answers; {twin.refused} datagrams were no commands{why}")
    return 0


def make_server(config: Config) -> WireServer:
    """Return the twin that `config` describes, not yet started.

    Raises:
        ValueError: the scene is out of range.
    """
    import numpy as np

    from hal.wire.controller import LABELS
    from sim_twin.controlled_world import ControlledWorld
    from sim_twin.scene import SceneConfig
    from sim_twin.wire_server import WireServer
    from sim_twin.world import World

    scene = SceneConfig(
        object=config.object,
        distance_m=config.distance_m,
        lateral_m=config.lateral_m,
        pitch_deg=config.pitch_deg,
    )
    q_start = np.append(LABELS["startFlat"], 0.0) if config.start == "startFlat" else None
    return WireServer(ControlledWorld(World(scene, q_start)), config.wire)

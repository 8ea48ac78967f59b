"""The twin's Z1 behind the vendor's UDP protocol: programs for a real Z1 drive it unmodified.

    ./z1 twin wire                                             as `z1_ctrl`: listens on 8071, answers to port 8072
    ./z1 twin wire --command-port 8073 --state-port 8074       a second arm
    ./z1 twin wire --depth board                               as the arm's motor board: the vendor's `z1_ctrl` drives
                                                               it on 8880, with this address in its config.xml
    ./z1 twin wire --view                                      shown live in Rerun

Stop it with Ctrl-C.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from hal.base.errors import HalError
from hal.process import stop_on_signals
from scripts.support.hal_process import READY
from sim_twin.drop_in.config import WireConfig

if TYPE_CHECKING:
    import numpy as np

    from sim_twin.drop_in.process import WireProcess
    from sim_twin.model.scene import SceneConfig

_POLL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Config:
    """Replaced part of the robot, addresses, initial pose and scene."""

    wire: Annotated[WireConfig, tyro.conf.arg(name="")] = field(default_factory=WireConfig)
    """Replaced part of the robot, and addresses."""
    start: Literal["startFlat", "home"] = "startFlat"
    """Initial pose: folded, as the real one is switched on, or home, the camera's viewpoint."""
    object: str = "bottle"
    """Object on the table: bottle, box or cylinder."""
    distance_m: float = 0.48
    """Distance of the object in front of the base [m]."""
    lateral_m: float = 0.0
    """Offset of the object to the left [m]."""
    pitch_deg: float = 0.0
    """Tilt of the object about the base's y axis [°]."""
    view: bool = False
    """Show it live in Rerun."""
    view_port: int = 9876
    """TCP port of the live view; a second arm needs another."""


def main(arguments: list[str]) -> int:
    """Serve until a signal arrives."""
    from sim_twin.drop_in.process import WireProcess

    config = tyro.cli(Config, prog="z1 twin wire", description=__doc__, args=arguments)
    wire = config.wire
    twin = WireProcess(make_scene(config), wire, start_pose(config.start))
    stop_event = Event()
    stop_on_signals(stop_event)
    with ExitStack() as undo:
        twin.start()
        undo.callback(twin.close)
        to = "the sender" if wire.depth == "board" else f"{wire.client_host}:{wire.state_port}"
        print(f"the twin's {wire.depth} listens on {wire.host}:{wire.port} and answers to {to}; Ctrl-C ends it.")
        print(READY, flush=True)
        if config.view:
            _show(twin, config.view_port, stop_event)
        while not stop_event.wait(_POLL_S) and twin.running:
            pass
        if ended := twin.exit_reason():
            raise HalError(ended)
        statistics = twin.statistics()
    reason = f" (the last one: {statistics['invalid_reason']})" if statistics["invalid_datagrams"] else ""
    print(f"{statistics['answers']} answers; {statistics['invalid_datagrams']} invalid datagrams{reason}")
    return 0


def make_scene(config: Config) -> SceneConfig:
    """Return the scene that `config` describes.

    Raises:
        ValueError: it is out of range.
    """
    from sim_twin.model.scene import SceneConfig

    return SceneConfig(
        object=config.object,
        distance_m=config.distance_m,
        lateral_m=config.lateral_m,
        pitch_deg=config.pitch_deg,
    )


def start_pose(start: Literal["startFlat", "home"]) -> np.ndarray | None:
    """Return where the arm starts, (7,) [rad]; None = at home."""
    import numpy as np

    from hal.z1_protocol.controller import LABELS

    # Jaws closed, as BACKTOSTART leaves them (measured).
    return np.append(LABELS["startFlat"], 0.0) if start == "startFlat" else None


def _show(twin: WireProcess, port: int, stop_event: Event) -> None:
    """Show the twin until `stop_event` is set, or its process ends."""
    from scripts.support.twin_view import RATE_HZ, TwinView

    view = TwinView(twin, port=port)
    try:
        while not stop_event.wait(1.0 / RATE_HZ) and twin.running:
            view.update()
    finally:
        view.close()

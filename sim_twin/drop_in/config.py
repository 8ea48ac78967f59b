"""Configuration of the twin behind the vendor's protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hal.base.errors import InvalidValueError
from hal.z1_protocol.controller import COMMAND_PORT, STATE_PORT
from hal.z1_protocol.motor_board import BOARD_PORT


@dataclass(frozen=True, slots=True, kw_only=True)
class WireConfig:
    """Part of the robot that the twin replaces, and its addresses; another arm needs other ports."""

    depth: Literal["controller", "board"] = "controller"
    """`controller`: in place of `z1_ctrl`, for programs that talk to it. `board`: in place of the arm's motor
    board and motors, for `z1_ctrl` itself, whose config.xml must name this address."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all of this machine's."""
    command_port: int = COMMAND_PORT
    """Port to listen on, as controller."""
    client_host: str = "127.0.0.1"
    """Machine of the client, as controller."""
    state_port: int = STATE_PORT
    """Port of the client, as controller."""
    board_port: int = BOARD_PORT
    """Port to listen on, as motor board; answers go to the sender of each datagram."""

    def __post_init__(self) -> None:
        for name in ("command_port", "state_port", "board_port"):
            if not 0 < getattr(self, name) < 65536:
                raise InvalidValueError(
                    f"WireConfig.{name} is {getattr(self, name)}; allowed are 1 to 65535.", code="port"
                )

    @property
    def port(self) -> int:
        """Port to listen on."""
        return self.board_port if self.depth == "board" else self.command_port

"""What the twin stands for on the wire, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hal.base.errors import InvalidValueError
from hal.z1_protocol.board import BOARD_PORT
from hal.z1_protocol.controller import COMMAND_PORT, STATE_PORT


@dataclass(frozen=True, slots=True, kw_only=True)
class WireConfig:
    """What the twin stands for, where it listens and whom it answers; another arm needs other ports."""

    depth: Literal["controller", "board"] = "controller"
    """`controller`: in place of `z1_ctrl`, for programs that talk to it. `board`: in place of the arm's board and
    motors, for `z1_ctrl` itself; give that one this address in its config.xml."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 for all of this machine's."""
    command_port: int = COMMAND_PORT
    """As controller: the port to listen on."""
    client_host: str = "127.0.0.1"
    """As controller: the client's machine."""
    state_port: int = STATE_PORT
    """As controller: the client's port."""
    board_port: int = BOARD_PORT
    """As board: the port to listen on; whoever asks is answered where he asks from."""

    def __post_init__(self) -> None:
        for name in ("command_port", "state_port", "board_port"):
            if not 0 < getattr(self, name) < 65536:
                raise InvalidValueError(f"{name} is {getattr(self, name)}; allowed are 1 to 65535.")

    @property
    def port(self) -> int:
        """The one it listens on."""
        return self.board_port if self.depth == "board" else self.command_port

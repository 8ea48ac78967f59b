"""Opening the Zenoh link: no discovery, one endpoint, loopback unless told otherwise."""

from __future__ import annotations

import ipaddress
import json
import logging
import re
from dataclasses import dataclass

import zenoh

from hal.base.errors import HalError, HalTimeoutError, InvalidValueError
from hal.bus.codec import MAX_BYTES

_LOG = logging.getLogger(__name__)
_MAX_COMMAND_BYTES = 8 * 2**20
"""Longest message the HAL process takes; the longest chunk (`hal.servo.trajectory_buffer.MAX_POINTS`) has 1.2 MB."""
_ROBOT = re.compile(r"[A-Za-z0-9_-]{1,40}")


@dataclass(frozen=True, slots=True, kw_only=True)
class BusConfig:
    """Where the HAL process is found, and how long to wait for it."""

    robot: str = "z1"
    """Name of the robot: the Zenoh namespace (letters, digits, `-`, `_`)."""
    host: str = "127.0.0.1"
    """Address the HAL process listens on; the link is neither encrypted nor authenticated, so keep it on loopback."""
    port: int = 7447
    """Its TCP port."""
    connect_timeout_s: float = 2.0
    """How long a client looks for the HAL process [s]."""
    request_timeout_s: float = 1.0
    """How long an answer may take [s]."""
    state_max_age_s: float = 0.2
    """Older measurements of the arm are not handed out [s]."""
    state_rate_hz: float = 100.0
    """How often the HAL publishes state and status [Hz]."""
    heartbeat_rate_hz: float = 50.0
    """How often the owner of the lease says that it lives [Hz]; the servo brakes after 0.15 s of silence."""
    shared_memory: bool = True
    """Whether frames go through shared memory where both ends can."""

    def __post_init__(self) -> None:
        if not _ROBOT.fullmatch(self.robot):
            raise InvalidValueError(f"robot is {self.robot!r}; allowed are 1 to 40 letters, digits, `-` and `_`.")
        if not 1 <= self.port <= 65535:
            raise InvalidValueError(f"port is {self.port}; allowed is 1 to 65535.")
        for name in ("connect_timeout_s", "request_timeout_s", "state_max_age_s", "state_rate_hz", "heartbeat_rate_hz"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InvalidValueError(f"{name} is {getattr(self, name)}; it must be above 0 and finite.")

    @property
    def endpoint(self) -> str:
        """The Zenoh endpoint."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp/{host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """Whether nobody outside this machine can reach the endpoint."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:  # a host name: it may lead anywhere
            return False


def open_session(config: BusConfig, *, listen: bool) -> zenoh.Session:
    """Return an open session: the HAL process listens, everyone else connects.

    Raises:
        HalError: the port is taken, or the address is not of this machine.
        HalTimeoutError: nobody listens there.
    """
    if listen and not config.is_loopback:
        _LOG.warning("whoever reaches %s can command the arm: the link is not encrypted.", config.endpoint)
    try:
        return zenoh.open(_zenoh_config(config, listen=listen))
    except zenoh.ZError as err:
        if not listen:
            raise no_answer_error(config) from err
        if "in use" in str(err):
            raise HalError(
                f"port {config.port} on {config.host} is taken: another HAL process is running, or another program "
                f"uses it; end that one, or choose another port with `--port`."
            ) from err
        raise HalError(f"cannot listen on {config.endpoint}: {err}; choose an address of this machine.") from err


def no_answer_error(config: BusConfig) -> HalTimeoutError:
    """Return the error for a link with nobody at the other end."""
    return HalTimeoutError(
        f"no HAL process answers at {config.endpoint} for robot {config.robot!r}; "
        f"start it with `./z1 hal --sim`, or check `--port` and the robot's name."
    )


def _zenoh_config(config: BusConfig, *, listen: bool) -> zenoh.Config:
    ends = {"endpoints": [config.endpoint], "exit_on_failure": True}
    none = {"endpoints": []}
    settings = {
        "mode": "peer" if listen else "client",
        "namespace": config.robot,
        "listen": ends if listen else none,
        "connect": none if listen else {**ends, "timeout_ms": int(1e3 * config.connect_timeout_s)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            # Zenoh would gather up to 1 GiB for whoever sends it.
            "link": {"rx": {"max_message_size": _MAX_COMMAND_BYTES if listen else MAX_BYTES}},
            "shared_memory": {
                "enabled": config.shared_memory,
                # Frames are placed in shared memory by hand (hal/bus/frames.py). Zenoh's own pool would also catch
                # queries, where restarts of the asking side leave segments behind.
                "mode": "lazy",
                "transport_optimization": {"enabled": False},
            },
        },
    }
    return zenoh.Config.from_json5(json.dumps(settings))

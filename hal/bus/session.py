"""Opening the Zenoh link: no discovery, one endpoint, loopback by default."""

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
"""Maximum message to the HAL process; the longest chunk (`hal.servo.trajectory_buffer.MAX_POINTS`) has 1.2 MB."""
_ROBOT = re.compile(r"[A-Za-z0-9_-]{1,40}")  # no character with a meaning in Zenoh's key expressions


@dataclass(frozen=True, slots=True, kw_only=True)
class BusConfig:
    """Address of the HAL process, and the timeouts of its clients."""

    robot: str = "z1"
    """Name of the robot: the Zenoh namespace (letters, digits, `-`, `_`)."""
    host: str = "127.0.0.1"
    """Address the HAL process listens on; the link is neither encrypted nor authenticated, so keep it on loopback."""
    port: int = 7447
    """Its TCP port."""
    connect_timeout_s: float = 2.0
    """How long a client waits for the HAL process [s]."""
    request_timeout_s: float = 1.0
    """How long an answer may take [s]."""
    state_max_age_s: float = 0.2
    """Maximum age of an arm state that `read_state` returns [s]."""
    state_rate_hz: float = 100.0
    """How often the HAL publishes state and status [Hz]."""
    heartbeat_rate_hz: float = 50.0
    """Rate of the lease owner's heartbeat [Hz]; the servo brakes after 0.15 s without one."""
    shared_memory: bool = True
    """True sends frames through shared memory where both ends can."""

    def __post_init__(self) -> None:
        if not _ROBOT.fullmatch(self.robot):
            raise InvalidValueError(
                f"bus: robot is {self.robot!r} (allowed 1 to 40 letters, digits, `-` and `_`).", code="invalid_robot"
            )
        if not 1 <= self.port <= 65535:
            raise InvalidValueError(f"bus: port is {self.port} (allowed 1 to 65535).", code="invalid_port")
        for name in ("connect_timeout_s", "request_timeout_s", "state_max_age_s", "state_rate_hz", "heartbeat_rate_hz"):
            if not 0 < getattr(self, name) < float("inf"):
                raise InvalidValueError(
                    f"bus: {name} is {getattr(self, name)} (allowed above 0 and finite).", code=f"invalid_{name}"
                )

    @property
    def endpoint(self) -> str:
        """The Zenoh endpoint."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp/{host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """True when the endpoint cannot be reached from outside this machine."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:  # a host name may resolve to any address
            return False


def open_session(config: BusConfig, *, listen: bool) -> zenoh.Session:
    """Return an open session: the HAL process listens, clients connect.

    Raises:
        HalError: the port is taken (`port_taken`), or the address is not of this machine (`invalid_address`).
        HalTimeoutError: no HAL process listens there (`no_hal`).
    """
    if listen and not config.is_loopback:
        _LOG.warning("any program that reaches %s can command the arm: the link is not encrypted.", config.endpoint)
    try:
        return zenoh.open(_zenoh_config(config, listen=listen))
    except zenoh.ZError as err:
        if not listen:
            raise no_answer_error(config) from err
        if "in use" in str(err):  # Zenoh has one class for all failures: only its text distinguishes them
            raise HalError(
                f"bus: port {config.port} on {config.host} is taken by another HAL process or another program. End "
                f"that one, or choose another port with `--port`.",
                code="port_taken",
            ) from err
        raise HalError(
            f"bus: cannot listen on {config.endpoint} ({err}). Choose an address of this machine.",
            code="invalid_address",
        ) from err


def no_answer_error(config: BusConfig) -> HalTimeoutError:
    """Return the error for a link without a HAL process at the other end."""
    return HalTimeoutError(
        f"bus: no HAL process answers at {config.endpoint} for robot {config.robot!r}. "
        f"Start it with `./z1 hal --sim`, or check `--port` and the robot's name.",
        code="no_hal",
    )


def _zenoh_config(config: BusConfig, *, listen: bool) -> zenoh.Config:
    ends = {"endpoints": [config.endpoint], "exit_on_failure": True}
    none = {"endpoints": []}
    settings = {
        "mode": "peer" if listen else "client",
        "namespace": config.robot,
        "listen": ends if listen else none,
        "connect": none if listen else {**ends, "timeout_ms": int(1e3 * config.connect_timeout_s)},
        # Explicit endpoints only: discovery would also find the HAL processes of other robots.
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            # By default Zenoh would gather a message of up to 1 GiB from any sender.
            "link": {"rx": {"max_message_size": _MAX_COMMAND_BYTES if listen else MAX_BYTES}},
            "shared_memory": {
                "enabled": config.shared_memory,
                # Frames are placed in shared memory by hand (hal/bus/frames.py). Zenoh's own pool would also take
                # queries, where restarts of the client leave segments behind.
                "mode": "lazy",
                "transport_optimization": {"enabled": False},
            },
        },
    }
    return zenoh.Config.from_json5(json.dumps(settings))

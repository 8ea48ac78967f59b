"""Opening the Zenoh link: no discovery, one endpoint, loopback by default; beyond it only with TLS and roles."""

from __future__ import annotations

import ipaddress
import json
import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from hal.base.errors import HalError, HalTimeoutError, InvalidValueError, MissingFileError
from hal.bus.access_control import ROLES, access_control, heartbeat_limit, size_limits
from hal.bus.codec import MAX_BYTES

_LOG = logging.getLogger(__name__)
_MAX_COMMAND_BYTES = 8 * 2**20
"""Maximum message to the HAL process; the longest chunk (`hal.servo.trajectory_buffer.MAX_POINTS`) has 1.2 MB."""
_MIN_SHARED_BYTES = 4 * 2**20
"""Space in /dev/shm below which Zenoh gets no shared memory: it would abort the process on its first segments."""
# Silent connections are closed after 0.5 s, twenty times an honest handshake on a loaded machine, and 300 of them
# still leave room for a client. Zenoh's own limits are 10 s and 100.
_ACCEPTING = {"accept_timeout": 500, "accept_pending": 400, "max_sessions": 32}
_ROBOT = re.compile(r"[A-Za-z0-9_-]{1,40}")  # no character with a meaning in Zenoh's key expressions


@dataclass(frozen=True, slots=True, kw_only=True)
class BusConfig:
    """Address of the HAL process, and the timeouts of its clients."""

    robot: str = "z1"
    """Name of the robot: the Zenoh namespace (letters, digits, `-`, `_`)."""
    host: str = "127.0.0.1"
    """Address the HAL process listens on; off loopback the link needs `keys`."""
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
    keys: str = ""
    """Folder with this party's certificate (`./z1 keys`): the link is then encrypted, and each client has a role."""

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
        return f"{'tls' if self.keys else 'tcp'}/{host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """True when the endpoint cannot be reached from outside this machine."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:  # a host name may resolve to any address
            return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificates:
    """Files of one party in a TLS link, as `./z1 keys` writes them."""

    authority: Path
    """Certificate of the robot's authority."""
    certificate: Path
    private_key: Path
    clients: Path
    """In the HAL's folder: role of each client's common name, in JSON."""

    @staticmethod
    def find(folder: str) -> Certificates:
        """Return the files in `folder`.

        Raises:
            MissingFileError: one is missing (`no_certificates`).
            InvalidValueError: other users can read the private key (`exposed_key`).
        """
        root = Path(folder)
        files = Certificates(
            authority=root / "authority.pem",
            certificate=root / "certificate.pem",
            private_key=root / "private.key",
            clients=root / "clients.json",
        )
        for path in (files.authority, files.certificate, files.private_key):
            if not path.is_file():
                raise MissingFileError(
                    f"bus: {path} is missing. Make the keys with `./z1 keys make`, and name this party's folder with "
                    f"`--keys`.",
                    code="no_certificates",
                )
        if files.private_key.stat().st_mode & 0o077:
            raise InvalidValueError(
                f"bus: other users can read {files.private_key}. Close it with `chmod 600`.", code="exposed_key"
            )
        return files

    def read_clients(self) -> tuple[str, dict[str, str]]:
        """Return the HAL's own common name, and the role of each client's.

        Raises:
            InvalidValueError: the file is missing or unreadable (`invalid_clients`): no client would be safe to serve.
        """
        try:
            content = json.loads(self.clients.read_text())
            own, clients = content["hal"], content["clients"]
            if not (isinstance(own, str) and all(isinstance(n, str) and clients[n] in ROLES for n in clients)):
                raise ValueError(f"roles must be of {', '.join(ROLES)}")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as err:
            raise InvalidValueError(
                f"bus: {self.clients} does not list the clients and their roles ({err}). `--keys` of a HAL names the "
                f"folder `hal` that `./z1 keys make` writes.",
                code="invalid_clients",
            ) from err
        return own, clients


def open_session(config: BusConfig, *, listen: bool, shared_memory: bool = False) -> zenoh.Session:
    """Return an open session: the HAL process listens, clients connect.

    Args:
        config: address, and the keys of a TLS link.
        listen: True for the HAL process.
        shared_memory: whether frames may come or go through shared memory.

    Raises:
        HalError: the port is taken (`port_taken`), or the address is not of this machine or TLS or the roles cannot be
            set up (`cannot_listen`).
        HalTimeoutError: no HAL process listens there (`no_hal`).
        InvalidValueError: the address is off loopback, and there are no keys (`open_network`).
        UsageError, MissingFileError: the keys cannot be used.
    """
    if not config.is_loopback and not config.keys:
        raise InvalidValueError(
            f"bus: {config.host} is not a loopback address, and the link is not encrypted (allowed: 127.0.0.1, or any "
            f"address with keys). Make keys with `./z1 keys make`, and name this party's folder with `--keys`.",
            code="open_network",
        )
    settings = zenoh_settings(config, listen=listen, shared_memory=shared_memory and has_shared_memory())
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
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
            f"bus: cannot listen on {config.endpoint} ({err}). Choose an address of this machine, and check the keys "
            f"when there are some.",
            code="cannot_listen",
        ) from err


def no_answer_error(config: BusConfig) -> HalTimeoutError:
    """Return the error for a link without a HAL process at the other end."""
    hint = " Or it rejects this certificate, or the address is not in its own." if config.keys else ""
    return HalTimeoutError(
        f"bus: no HAL process answers at {config.endpoint} for robot {config.robot!r}. "
        f"Start it with `./z1 hal --sim`, or check `--port` and the robot's name.{hint}",
        code="no_hal",
    )


def has_shared_memory() -> bool:
    """Return True when /dev/shm has room for Zenoh's segments, with a warning when it has not."""
    try:
        space = os.statvfs("/dev/shm")
    except OSError:
        return False
    enough = space.f_bavail * space.f_frsize >= _MIN_SHARED_BYTES
    if not enough:
        _LOG.warning("/dev/shm is full or very small: frames go as bytes over the link, a few milliseconds slower.")
    return enough


def zenoh_settings(config: BusConfig, *, listen: bool, shared_memory: bool) -> dict[str, Any]:
    """Return Zenoh's settings of a session (errors as `open_session`)."""
    ends = {"endpoints": [config.endpoint], "exit_on_failure": True}
    none = {"endpoints": []}
    # By default Zenoh would gather a message of up to 1 GiB from any sender.
    link: dict[str, Any] = {"rx": {"max_message_size": _MAX_COMMAND_BYTES if listen else MAX_BYTES}}
    own_name, clients = "", None
    if config.keys:
        files = Certificates.find(config.keys)
        link |= {"protocols": ["tls"], "tls": _tls_settings(files)}
        if listen:
            own_name, clients = files.read_clients()
    settings: dict[str, Any] = {
        "mode": "peer" if listen else "client",
        "namespace": config.robot,
        "listen": ends if listen else none,
        "connect": none if listen else {**ends, "timeout_ms": int(1e3 * config.connect_timeout_s)},
        # Explicit endpoints only: discovery would also find the HAL processes of other robots.
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": _ACCEPTING if listen else {},
            "link": link,
            "shared_memory": {
                "enabled": shared_memory,
                # Frames are placed in shared memory by hand (hal/bus/frames.py). Zenoh's own pool would also take
                # queries, where restarts of the client leave segments behind.
                "mode": "lazy",
                "transport_optimization": {"enabled": False},
            },
        },
    }
    if listen:
        settings["access_control"] = access_control(config.robot, clients, own_name)
        settings["downsampling"] = heartbeat_limit(config.robot)
        settings["low_pass_filter"] = size_limits(config.robot)
    return settings


def _tls_settings(files: Certificates) -> dict[str, Any]:
    key, certificate = str(files.private_key), str(files.certificate)
    return {
        "root_ca_certificate": str(files.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_private_key": key,
        "listen_certificate": certificate,
        "connect_private_key": key,
        "connect_certificate": certificate,
    }

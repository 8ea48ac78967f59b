"""Keys of a link beyond this machine: TLS certificates with roles.

./z1 keys make --address 192.168.1.10    make the authority, and the HAL's key for its addresses
./z1 keys add NAME --role operator       add a client; copy its folder to the client's machine
./z1 keys revoke NAME                    take a client's access away
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from scripts.keys.certificates import HAL, add_client, make_keys, revoke_client


@dataclass(frozen=True, kw_only=True)
class KeyFolder:
    """Place of the keys."""

    folder: Path = field(default_factory=lambda: Path.home() / ".config" / "z1" / "keys")
    """Folder of the authority, with one folder for each party."""


@dataclass(frozen=True, kw_only=True)
class Make(KeyFolder):
    """Make the authority and the HAL's key."""

    address: tuple[str, ...] = ()
    """Addresses or host names of the robot's PC, as clients will name them with `--host`."""
    days: int = 3650
    """Validity of authority and HAL [days]."""


@dataclass(frozen=True, kw_only=True)
class Add(KeyFolder):
    """Add a client."""

    name: tyro.conf.Positional[str]
    """Name of the client."""
    role: Literal["operator", "viewer"]
    """An operator commands the arm; a viewer reads, and can stop it."""
    days: int = 365
    """Validity [days]."""


@dataclass(frozen=True, kw_only=True)
class Revoke(KeyFolder):
    """Take a client's access away."""

    name: tyro.conf.Positional[str]
    """Name of the client."""


Config = (
    Annotated[Make, tyro.conf.subcommand("make")]
    | Annotated[Add, tyro.conf.subcommand("add")]
    | Annotated[Revoke, tyro.conf.subcommand("revoke")]
)
"""Options of one step."""


def main(config: Make | Add | Revoke) -> int:
    """Run the step of `config`."""
    hal = config.folder / HAL
    if isinstance(config, Make):
        make_keys(config.folder, config.address, config.days)
        print(f"made {config.folder}; serve with: ./z1 hal --real --host ADDRESS --keys {hal}")
        print("add clients with: ./z1 keys add NAME --role operator")
    elif isinstance(config, Add):
        folder = add_client(config.folder, config.name, config.role, config.days)
        print(f"made {folder}; copy it to the client's machine, and connect with: --host ADDRESS --keys FOLDER")
        print(f"a running HAL learns of it at its next start, from {hal}")
    else:
        revoke_client(config.folder, config.name)
        print(f"revoked {config.name}; start the HAL again, with {hal}, for it to take effect")
    return 0

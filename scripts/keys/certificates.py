"""Certificates of a robot's link: a small authority, one certificate for the HAL, and one for each client.

Made by the `openssl` program, version 3. Each party's folder is all that its machine needs (`hal.bus.session`). The
authority's own key signs new clients only: keep its folder off the robot.
"""

from __future__ import annotations

import json
import re
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from ipaddress import ip_address
from pathlib import Path

from hal.base.errors import HalError, InvalidValueError, MissingFileError, OutputExistsError
from hal.base.files import atomic_write
from hal.bus.access_control import ROLES

AUTHORITY, HAL = "authority", "hal"
_MAX_DAYS = 36_500
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_NAME = re.compile(r"[A-Za-z0-9-]{1,40}")  # neither a dot, which separates the suffix, nor a path's separator
_AUTHORITY_USE = "basicConstraints=critical,CA:TRUE,pathlen:0\nkeyUsage=critical,keyCertSign"
_PARTY_USE = "basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\nextendedKeyUsage="
# A client's certificate cannot serve, so that no client can take the HAL's place.
_CLIENT_USE = f"{_PARTY_USE}clientAuth"
_HAL_USE = f"{_PARTY_USE}serverAuth,clientAuth\nsubjectAltName="


def make_keys(root: Path, addresses: Sequence[str], days: int) -> None:
    """Write the authority and the HAL's folder to `root`.

    Args:
        root: new folder.
        addresses: addresses or host names at which clients reach the HAL; loopback is added.
        days: validity.

    Raises:
        OutputExistsError: `root` exists: its clients would lose their access.
        InvalidValueError: an address is none.
        HalError: there is no usable `openssl` (`no_openssl`), or it failed (`openssl_failed`).
    """
    if root.exists():
        raise OutputExistsError(f"keys: {root} exists. Add clients to it, or choose another `--folder`.")
    _check_days(days)
    names = ",".join(_alternative_name(address) for address in dict.fromkeys((*addresses, *_LOOPBACK)))
    partial = root.with_name(f".{root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(mode=0o700, parents=True)
    try:
        _make_certificate(partial / AUTHORITY, "z1 authority", _AUTHORITY_USE, days, authority=None)
        common_name = _draw_name(HAL)
        _make_certificate(partial / HAL, common_name, _HAL_USE + names, days, authority=partial / AUTHORITY)
        _write_clients(partial, {HAL: common_name, "clients": {}})
        partial.rename(root)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def add_client(root: Path, name: str, role: str, days: int) -> Path:
    """Write the folder of a new client and give it its role; return the folder.

    Raises:
        InvalidValueError: `name` or `role` is not allowed.
        OutputExistsError: there is a client of that name.
        MissingFileError: `root` has no authority.
        HalError: as `make_keys`.
    """
    if not _NAME.fullmatch(name) or name in (AUTHORITY, HAL):
        raise InvalidValueError(
            f"keys: name is {name!r} (allowed 1 to 40 letters, digits and `-`).", code="invalid_name"
        )
    if role not in ROLES:
        raise InvalidValueError(f"keys: role is {role!r} (allowed {', '.join(ROLES)}).", code="invalid_role")
    _check_days(days)
    content, folder = _read_clients(root), root / name
    if folder.exists():
        raise OutputExistsError(f"keys: {folder} exists. Revoke that client first, or choose another name.")
    # The suffix makes a revoked certificate stay revoked when a client of its name is added again.
    common_name = _draw_name(name)
    _make_certificate(folder, common_name, _CLIENT_USE, days, authority=root / AUTHORITY)
    content["clients"][common_name] = role
    _write_clients(root, content)
    return folder


def revoke_client(root: Path, name: str) -> None:
    """Take the role of a client away and remove its folder here; a copy of it elsewhere is worthless then.

    Raises:
        InvalidValueError: there is no client of that name (`unknown_client`).
        MissingFileError: `root` has no authority.
    """
    content = _read_clients(root)
    revoked = [known for known in content["clients"] if known.rpartition(".")[0] == name]
    if not revoked:
        known = ", ".join(known.rpartition(".")[0] for known in content["clients"]) or "none"
        raise InvalidValueError(f"keys: there is no client {name!r} (known: {known}).", code="unknown_client")
    for common_name in revoked:
        del content["clients"][common_name]
    _write_clients(root, content)
    shutil.rmtree(root / name, ignore_errors=True)


def _draw_name(name: str) -> str:
    return f"{name}.{secrets.token_hex(4)}"


def _check_days(days: int) -> None:
    if not 1 <= days <= _MAX_DAYS:
        raise InvalidValueError(f"keys: days is {days} (allowed 1 to {_MAX_DAYS}).", code="invalid_days")


def _alternative_name(address: str) -> str:
    try:
        return f"IP:{ip_address(address)}"
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9.-]{1,253}", address):
            raise InvalidValueError(
                f"keys: {address!r} is neither an address nor a host name.", code="invalid_address"
            ) from None
        return f"DNS:{address}"


def _read_clients(root: Path) -> dict:
    path = root / HAL / "clients.json"
    if not path.is_file() or not (root / AUTHORITY / "private.key").is_file():
        raise MissingFileError(f"keys: {root} has no authority. Make one with `./z1 keys make`.", code="no_authority")
    return json.loads(path.read_text())


def _write_clients(root: Path, content: dict) -> None:
    atomic_write(root / HAL / "clients.json", json.dumps(content, indent=1) + "\n")


def _make_certificate(folder: Path, common_name: str, use: str, days: int, *, authority: Path | None) -> None:
    """Write key and certificate to the new `folder`; without an authority the certificate signs itself."""
    with tempfile.TemporaryDirectory(dir=folder.parent) as partial, tempfile.NamedTemporaryFile("w") as config:
        private_key, certificate = Path(partial, "private.key"), Path(partial, "certificate.pem")
        config.write(
            f"[req]\ndistinguished_name=dn\nx509_extensions=use\nprompt=no\n[dn]\nCN={common_name}\n"
            f"[use]\nsubjectKeyIdentifier=hash\nauthorityKeyIdentifier=keyid\n{use}\n"
        )
        config.flush()
        signer = (
            [] if authority is None else ["-CA", authority / "certificate.pem", "-CAkey", authority / "private.key"]
        )
        _run_openssl(
            *("req", "-x509", "-config", config.name, "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"),
            *("-nodes", "-keyout", private_key, "-out", certificate, "-days", days, *signer),
        )
        private_key.chmod(0o600)
        shutil.copy(certificate if authority is None else authority / "certificate.pem", Path(partial, "authority.pem"))
        Path(partial).rename(folder)
        Path(partial).mkdir()  # which the context removes


def _run_openssl(*arguments: object) -> None:
    command = ["openssl", *map(str, arguments)]
    try:
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise HalError(
            "keys: there is no program `openssl`. Install it: sudo apt install openssl", code="no_openssl"
        ) from error
    if run.returncode:
        raise HalError(
            f"keys: openssl failed ({run.stderr.strip()[-300:]}). Version 3 or later is needed.", code="openssl_failed"
        )

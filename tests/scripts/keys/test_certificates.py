"""Keys of a link beyond one machine."""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

from hal.base.errors import HalError, InvalidValueError, MissingFileError, OutputExistsError
from scripts import cli
from scripts.keys.certificates import add_client, make_keys, revoke_client
from tests.support.errors import raises

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="makes certificates with openssl"),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("keys") / "robot"
    make_keys(root, ["192.168.1.10", "robot.local"], days=10)
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "robot")
    return tmp_path / "robot"


def clients(root: Path) -> dict[str, str]:
    content = json.loads((root / "hal/clients.json").read_text())
    return {name.rpartition(".")[0]: role for name, role in content["clients"].items()}


def show(certificate: Path) -> str:
    command = ["openssl", "x509", "-in", certificate, "-noout", "-text"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_the_hal_serves_its_addresses_and_a_client_cannot_serve(root: Path) -> None:
    hal, client = show(root / "hal/certificate.pem"), show(add_client(root, "ann", "operator", 5) / "certificate.pem")
    for part in ("IP Address:192.168.1.10", "DNS:robot.local", "IP Address:127.0.0.1", "TLS Web Server Authentication"):
        assert part in hal
        assert part not in client
    assert "TLS Web Client Authentication" in client
    assert "CA:FALSE" in hal and "CA:FALSE" in client


def test_private_keys_and_folders_are_the_users_alone(root: Path) -> None:
    add_client(root, "ann", "viewer", 5)
    for party in ("authority", "hal", "ann"):
        assert stat.S_IMODE((root / party).stat().st_mode) == 0o700
        assert stat.S_IMODE((root / party / "private.key").stat().st_mode) == 0o600


def test_a_role_ends_with_its_revocation_and_a_new_key_is_another(root: Path) -> None:
    add_client(root, "ann", "operator", 5)
    first = json.loads((root / "hal/clients.json").read_text())["clients"]
    add_client(root, "ben", "viewer", 5)
    assert clients(root) == {"ann": "operator", "ben": "viewer"}
    revoke_client(root, "ann")
    assert clients(root) == {"ben": "viewer"}
    add_client(root, "ann", "operator", 5)
    assert not set(first) & set(json.loads((root / "hal/clients.json").read_text())["clients"])


def test_what_exists_is_not_overwritten(root: Path) -> None:
    with raises(OutputExistsError, "output_exists"):
        make_keys(root, [], 5)
    add_client(root, "ann", "operator", 5)
    with raises(OutputExistsError, "output_exists"):
        add_client(root, "ann", "viewer", 5)
    assert clients(root) == {"ann": "operator"}


@pytest.mark.parametrize("name", ["", "hal", "authority", "a.b", "../x", "a/b", "a\n", "x" * 41])
def test_a_name_that_is_none_is_rejected(root: Path, name: str) -> None:
    with raises(InvalidValueError, "invalid_name"):
        add_client(root, name, "operator", 5)


def test_other_bad_input_is_rejected(root: Path, tmp_path: Path) -> None:
    with raises(InvalidValueError, "invalid_role"):
        add_client(root, "ann", "king", 5)
    with raises(InvalidValueError, "invalid_days"):
        add_client(root, "ann", "viewer", 0)
    with raises(InvalidValueError, "invalid_address"):
        make_keys(tmp_path / "new", ["not an address"], 5)
    with raises(InvalidValueError, "unknown_client"):
        revoke_client(root, "ann")
    with raises(MissingFileError, "no_authority"):
        add_client(tmp_path / "none", "ann", "viewer", 5)
    assert not (tmp_path / "new").exists()


def test_without_openssl_there_is_a_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with raises(HalError, "no_openssl"):
        make_keys(tmp_path / "new", [], 5)
    assert list(tmp_path.iterdir()) == []


def test_the_command_makes_adds_and_revokes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = ["--folder", str(tmp_path / "keys")]
    assert cli.main(["keys", "make", *folder, "--address", "10.0.0.1", "robot.local"]) == 0
    assert cli.main(["keys", "add", "ann", *folder, "--role", "viewer"]) == 0
    assert cli.main(["keys", "revoke", "ann", *folder]) == 0
    assert clients(tmp_path / "keys") == {}
    assert cli.main(["keys", "revoke", "ann", *folder]) == 2
    assert "unknown" not in capsys.readouterr().out

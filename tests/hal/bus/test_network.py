"""The link beyond one machine: mutual TLS and roles, between two network namespaces where they are permitted."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hal.base.errors import HalError, InvalidValueError, MissingFileError, Z1Error
from hal.bus import keys
from hal.bus.session import BusConfig, open_session
from hal.bus.stop_socket import StopClient
from scripts.keys.certificates import add_client, make_keys, revoke_client
from tests.support.errors import raises
from tests.support.hal.bus_hal import ROOT, end_processes, free_config
from tests.support.hal.networks import make_networks

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="makes certificates with openssl"),
]

SERVE = """
import sys
from threading import Event
from hal.backends.mock_arm import make_rig
from hal.bus import keys
from hal.bus.session import BusConfig
from hal.process import serve
config = BusConfig(host=sys.argv[1], port=int(sys.argv[2]), keys=sys.argv[3])
serve(make_rig(), config, Event(), on_ready=lambda: print("ready", flush=True))
"""


def openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of keys: an operator, a viewer, and parties that must stay outside."""
    root = tmp_path_factory.mktemp("keys") / "robot"
    make_keys(root, ["10.77.0.1", "127.0.0.2"], days=2)
    for name, role in (
        ("operator", "operator"),
        ("viewer", "viewer"),
        ("revoked", "operator"),
        ("expired", "operator"),
    ):
        add_client(root, name, role, days=2)
    shutil.copytree(root / "revoked", root / "kept")  # the copy on a client's machine
    revoke_client(root, "revoked")
    (root / "kept").rename(root / "revoked")
    expired, request = root / "expired", root / "expired.csr"
    name = next(name for name in json.loads((root / "hal/clients.json").read_text())["clients"] if "expired" in name)
    openssl("req", "-new", "-key", expired / "private.key", "-subj", f"/CN={name}", "-out", request)
    signer = ("-CA", root / "authority/certificate.pem", "-CAkey", root / "authority/private.key")
    openssl("x509", "-req", "-in", request, *signer, "-days", "-1", "-out", expired / "certificate.pem")
    # The same names from another authority, and signed by themselves
    foreign = root.parent / "foreign"
    make_keys(foreign, [], days=2)
    operator = next(n for n in json.loads((root / "hal/clients.json").read_text())["clients"] if "operator" in n)
    for party, signer in (
        ("foreign", ("-CA", foreign / "authority/certificate.pem", "-CAkey", foreign / "authority/private.key")),
        ("stranger", ()),
    ):
        shutil.copytree(root / "viewer", root / party)
        key = root / party / "private.key"
        openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-subj", f"/CN={operator}", *signer,
                "-out", root / party / "certificate.pem")  # fmt: skip
        key.chmod(0o600)
    return root


@pytest.fixture(scope="module")
def found(root: Path) -> Iterator[dict]:
    """Yield what each party could do from outside, and the HAL's last status."""
    config = free_config()
    with make_networks() as networks:
        command = [sys.executable, "-c", SERVE, networks.address, str(config.port), str(root / "hal")]
        hal = subprocess.Popen([*networks.robot, *command], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        try:
            assert hal.stdout is not None
            assert hal.stdout.readline() == "ready\n"
            client = [sys.executable, "-m", "tests.support.hal.network_client", root, networks.address, config.port]
            run = subprocess.run(
                [*networks.outside, *map(str, client)],
                cwd=ROOT,
                capture_output=True,
                text=True,
                check=False,
                timeout=120,
            )
            assert run.returncode == 0, run.stderr
            status = StopClient("z1", config.port)
            yield {**json.loads(run.stdout), "hal": status.read_status()}
            status.close()
        finally:
            end_processes(hal)


def test_an_operator_commands(found):
    operator = found["operator"]
    assert {operator[step] for step in ("connect", "read", "claim", "stream", "rearm")} == {"done"}
    assert operator["owner"].startswith("tester-")
    assert "srv/claim" in operator["answered"]  # which the tests below find missing


def test_a_viewer_reads_and_commands_nothing(found):
    viewer = found["viewer"]
    assert (viewer["connect"], viewer["read"]) == ("done", "done")
    assert {viewer[command] for command in ("claim", "stream", "rearm")} == {"no_permission"}
    assert viewer["answered"] == []


@pytest.mark.parametrize("party", ["stranger", "foreign", "expired"])
def test_a_stranger_a_foreign_and_an_expired_certificate_get_no_session(found, party):
    assert found[party] == {"connect": "no_hal", "refused": "no_hal"}


def test_a_revoked_client_reads_and_commands_nothing(found):
    assert found["revoked"] == {"connect": "no_hal", "answered": [], "heard": []}


@pytest.mark.parametrize("party", ["operator", "viewer"])
def test_no_client_hears_or_answers_the_requests_of_another(found, party):
    heard = set(found[party]["heard"])
    assert "state" in heard  # the listener works
    assert heard <= set(keys.PUBLISHED)


def test_a_client_without_keys_does_not_try(found):
    assert found["without keys"] == {"connect": "open_network"}


def test_a_replayed_session_gets_nothing(found):
    replay = found["replay"]
    assert replay["claim"] == replay["stream"] == "done"  # the recorded session was a good one
    assert replay["recorded"] > 1000
    assert replay["answered"] < 2000  # the HAL's half of a handshake: the replayed half proves no key
    assert found["hal"].mode == "holding"
    assert found["hal"].owner == ""


# --- A link that cannot be set up -----------------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "robot.local"])
@pytest.mark.parametrize("listen", [True, False])
def test_off_loopback_without_keys_is_refused(host, listen):
    with raises(InvalidValueError, "open_network"):
        open_session(BusConfig(host=host), listen=listen)


def _remove(name):
    return lambda folder: (folder / name).unlink()


def _write(name, text):
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (_remove("authority.pem"), "no_certificates"),
        (_remove("certificate.pem"), "no_certificates"),
        (_remove("private.key"), "no_certificates"),
        (_remove("clients.json"), "invalid_clients"),
        (_write("clients.json", "no JSON"), "invalid_clients"),
        (_write("clients.json", '{"hal": "x", "clients": {"a": "king"}}'), "invalid_clients"),
        (_write("clients.json", '{"hal": "x", "clients": ["a"]}'), "invalid_clients"),
        (_write("authority.pem", "no certificate"), "cannot_listen"),
        (_write("certificate.pem", "no certificate"), "cannot_listen"),
        (_write("private.key", "no key"), "cannot_listen"),
        (lambda folder: shutil.copy(folder.parent / "viewer/private.key", folder / "private.key"), "cannot_listen"),
        (lambda folder: (folder / "private.key").chmod(0o640), "exposed_key"),
    ],
)
def test_a_hal_whose_tls_or_roles_cannot_be_set_up_does_not_listen(root, tmp_path, damage, code):
    shutil.copytree(root / "hal", tmp_path / "hal")
    shutil.copytree(root / "viewer", tmp_path / "viewer")
    damage(tmp_path / "hal")
    config = free_config(keys=str(tmp_path / "hal"), connect_timeout_s=0.3)
    with pytest.raises(Z1Error) as caught:
        open_session(config, listen=True)
    assert caught.value.code == code
    with pytest.raises(Z1Error):  # and the port is closed
        open_session(BusConfig(port=config.port, connect_timeout_s=0.1), listen=False)


def test_a_client_does_not_take_another_clients_certificate_for_the_hals(root):
    """A viewer that listens at the HAL's address is recognised: its certificate cannot serve."""
    config = free_config(connect_timeout_s=0.5)
    listening = BusConfig(port=config.port, keys=str(root / "viewer"))
    (root / "viewer/clients.json").write_text((root / "hal/clients.json").read_text())
    connecting = BusConfig(port=config.port, keys=str(root / "operator"), connect_timeout_s=0.5)
    with open_session(listening, listen=True), raises(HalError, "no_hal"):
        open_session(connecting, listen=False)


def test_a_hal_at_an_address_that_its_certificate_does_not_name_is_not_taken_for_it(root):
    config = free_config(host="127.0.0.3", keys=str(root / "hal"), connect_timeout_s=0.5)
    with open_session(config, listen=True), raises(HalError, "no_hal"):
        open_session(replace(config, keys=str(root / "operator")), listen=False)


def test_missing_keys_name_the_command_that_makes_them(tmp_path):
    with raises(MissingFileError, "no_certificates") as caught:
        open_session(free_config(keys=str(tmp_path)), listen=False)
    assert "./z1 keys make" in str(caught.value)

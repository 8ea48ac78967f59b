"""The stop over a Unix socket."""

from __future__ import annotations

import os
import socket
import stat
from dataclasses import replace
from pathlib import Path

import pytest

from hal.base.errors import CommandRejectedError, HalError, HalTimeoutError
from hal.base.messages import ServoMode
from hal.base.runtime_folder import find_file, make_runtime_folder, runtime_folders
from hal.bus.client import RemoteArm
from hal.bus.runtime_files import make_secret, read_secret
from hal.bus.stop_socket import StopAnswer, StopClient, StopSocket
from tests.support.errors import raises
from tests.support.hal.bus_hal import wait_until

pytestmark = pytest.mark.integration


@pytest.fixture(autouse=True)
def own_folder(tmp_path_factory, monkeypatch) -> Path:
    parent = Path(os.environ["XDG_RUNTIME_DIR"]) / f"own-{os.urandom(4).hex()}"
    parent.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(parent))
    # Not the folders that a service would look into: this user's own HAL may have its files there
    monkeypatch.setattr("hal.base.runtime_folder.runtime_folders", lambda: (parent / "z1",))
    return parent / "z1"


def make_socket(stop=lambda reason: None) -> StopSocket:
    return StopSocket("z1", 7447, stop, lambda: StopAnswer("stopped", "tab\tand\nline", "me-1"))


def test_a_stop_is_answered_by_the_status():
    reasons: list[str] = []
    server = make_socket(reasons.append)
    client = StopClient("z1", 7447)
    assert client.stop("a reason ü") == ("stopped", "tab and line", "me-1")
    assert client.read_status().mode == "stopped"
    assert reasons == ["a reason ü"]
    client.close()
    server.close()
    server.close()
    assert not server.path.exists()


def test_only_the_user_can_open_it():
    server = make_socket()
    assert stat.S_IMODE(server.path.lstat().st_mode) == 0o600
    assert stat.S_IMODE(server.path.parent.lstat().st_mode) == 0o700
    server.path.chmod(0o666)  # what another user might have made
    with raises(HalTimeoutError, "no_hal"):
        StopClient("z1", 7447)
    server.close()


def test_without_a_hal_or_after_a_killed_one_there_is_none():
    with raises(HalTimeoutError, "no_hal"):
        StopClient("z1", 7447)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as killed:
        killed.bind(str(path := make_runtime_folder() / "z1-7447.stop"))
        path.chmod(0o600)  # the file stays
    with raises(HalTimeoutError, "no_hal"):
        StopClient("z1", 7447)
    make_socket().close()  # and a new HAL replaces it


def test_an_error_and_garbage_leave_it_serving():
    def reject(reason: str) -> None:
        raise ZeroDivisionError if reason == "bug" else CommandRejectedError("it only monitors.", code="monitor_only")

    server = make_socket(reject)
    client = StopClient("z1", 7447)
    for reason in ("bug", "no"):
        with raises(HalError, "stop_rejected"):
            client.stop(reason)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as silent:  # without an address for the answer
        for data in (b"", b"end", b"\xff" * 4096, b"stop \xff"):
            silent.sendto(data, str(server.path))
    assert client.read_status().owner == "me-1"
    client.close()
    server.close()


def test_a_silent_hal_is_a_timeout(own_folder):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as silent:
        path = make_runtime_folder() / "z1-7447.stop"
        silent.bind(str(path))
        path.chmod(0o600)
        with raises(HalTimeoutError, "no_answer"):
            StopClient("z1", 7447, timeout_s=0.05).stop("now")


def test_the_hal_stops_by_its_socket_while_silent_connections_fill_the_port(hal):
    silent = []
    try:
        for _ in range(300):
            silent.append(socket.create_connection(("127.0.0.1", hal.config.port), timeout=1.0))
        client = StopClient("z1", hal.config.port)
        client.stop("in a crowd")
        wait_until(lambda: client.read_status().mode == ServoMode.STOPPED.value)
        assert hal.servo.status().reason == "in a crowd"
        client.close()
    finally:
        for connection in silent:
            connection.close()


def test_a_client_connects_while_silent_connections_wait(hal):
    address = ("127.0.0.1", hal.config.port)
    silent = [socket.create_connection(address, timeout=5.0) for _ in range(300)]
    try:
        with RemoteArm(replace(hal.config, connect_timeout_s=10.0)) as arm:
            arm.stop("over the link")
        assert hal.servo.status().reason == "over the link"
    finally:
        for connection in silent:
            connection.close()


def test_a_secret_is_drawn_once_and_readable_by_the_user_alone(own_folder):
    secret = make_secret(7447)
    assert make_secret(7447) == read_secret(7447) == secret != make_secret(7448)
    path = find_file("7447.secret")
    assert path is not None and stat.S_IMODE(path.stat().st_mode) == 0o600
    path.chmod(0o640)
    assert read_secret(7447) is None
    path.chmod(0o600)
    path.write_bytes(b"short")
    assert read_secret(7447) is None
    assert len(make_secret(7447)) == len(secret)


def test_links_and_open_folders_are_not_followed(own_folder, tmp_path):
    folder = make_runtime_folder()
    assert folder == own_folder == runtime_folders()[0]
    (tmp_path / "secret").write_bytes(bytes(32))
    (tmp_path / "secret").chmod(0o600)
    (folder / "1.secret").symlink_to(tmp_path / "secret")
    assert read_secret(1) is None
    make_secret(7447)
    assert find_file("7447.secret") is not None
    folder.chmod(0o770)
    with raises(HalError, "unsafe_runtime_folder"):
        make_runtime_folder()
    assert find_file("7447.secret") is None

"""Opening the link: failures are reported before anything moves."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hal.base.clock import WallClock
from hal.base.errors import HalError, HalTimeoutError, InvalidValueError
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.link import BusLink
from hal.bus.session import BusConfig, open_session
from tests.support.errors import raises
from tests.support.hal.bus_hal import ROOT, free_config, wait_until

pytestmark = pytest.mark.integration


@pytest.mark.parametrize(
    "options",
    [
        {"robot": ""},
        {"robot": "a/b"},
        {"robot": "*"},
        {"port": 0},
        {"port": 70000},
        {"request_timeout_s": 0.0},
        {"state_rate_hz": float("inf")},
        {"connect_timeout_s": float("nan")},
    ],
)
def test_an_invalid_config_is_rejected(options):
    with raises(InvalidValueError, f"invalid_{next(iter(options))}"):
        BusConfig(**options)


@pytest.mark.parametrize(
    ("host", "loopback"), [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("z1", False)]
)
def test_only_a_loopback_address_is_loopback(host, loopback):
    assert BusConfig(host=host).is_loopback is loopback


def test_a_port_in_use_is_an_error_with_port_and_remedy():
    config = free_config()
    with open_session(config, listen=True), raises(HalError, "port_taken") as caught:
        open_session(config, listen=True)
    for part in (f"port {config.port} on 127.0.0.1", "`--port`"):
        assert part in str(caught.value)


@pytest.mark.parametrize("device", [RemoteArm, RemoteCamera])
def test_a_client_without_a_hal_process_gets_the_command_that_starts_one(device):
    config = free_config(connect_timeout_s=0.3)
    with raises(HalTimeoutError, "no_hal") as caught:
        device(config).connect()
    for part in (str(config.port), "`./z1 hal --sim`"):
        assert part in str(caught.value)


def test_a_client_of_another_robot_finds_no_hal_process(hal):
    config = BusConfig(port=hal.config.port, robot="other", connect_timeout_s=0.3)
    with raises(HalTimeoutError, "no_hal"):
        RemoteArm(config).connect()


def _own_sockets(table: str) -> list[list[str]]:
    """Return the rows of /proc/net/`table` that belong to this process."""
    own = {os.readlink(fd) for fd in Path("/proc/self/fd").iterdir() if os.path.lexists(fd)}
    rows = [row.split() for row in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]]
    return [row for row in rows if f"socket:[{row[9]}]" in own]


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="reads Linux's socket tables")
def test_the_session_listens_on_its_loopback_endpoint_and_scouts_nowhere():
    config = free_config()
    before = [row[1] for row in _own_sockets("udp") + _own_sockets("udp6")]
    with open_session(config, listen=True):
        listening = [row[1] for row in _own_sockets("tcp") + _own_sockets("tcp6") if row[3] == "0A"]
        assert listening == [f"0100007F:{config.port:04X}"]
        assert [row[1] for row in _own_sockets("udp") + _own_sockets("udp6")] == before


def _open_files() -> list[str]:
    names = []
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            names.append(os.readlink(descriptor))
        except FileNotFoundError:  # the one of the listing itself
            continue
    return sorted(names)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="reads Linux's descriptor tables")
@pytest.mark.parametrize("shared_memory", [False, True])
def test_a_closed_link_leaves_no_descriptor_open(hal, shared_memory):
    def connect() -> None:
        BusLink(hal.config, WallClock(), "a client", shared_memory=shared_memory).close()

    connect()
    before = len(_open_files())
    for _ in range(5):
        connect()
    wait_until(lambda: len(_open_files()) <= before)


FRAMES_WITHOUT_ROOM = """
import logging, sys
from threading import Event
from hal.backends.mock_arm import make_rig
from hal.bus.client import RemoteCamera
from hal.bus.session import BusConfig
from hal.process import serve
logging.basicConfig(level=logging.WARNING)
config, end = BusConfig(port=int(sys.argv[1]), connect_timeout_s=10.0), Event()

def watch():
    with RemoteCamera(config) as camera:
        print(camera.wait_for_frame(5.0).sequence >= 0, camera.shared_memory)
    end.set()

serve(make_rig(), config, end, on_ready=watch)
"""


@pytest.mark.skipif(shutil.which("unshare") is None, reason="makes a mount namespace")
@pytest.mark.parametrize("size", ["64k", "1m", "3m"])
def test_a_small_shm_folder_leaves_a_link_that_sends_bytes(size):
    mount = f"mount -t tmpfs -o size={size} tmpfs /dev/shm || exit 77"
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", f'{mount}; exec "$@"', "sh"]
    program = [sys.executable, "-c", FRAMES_WITHOUT_ROOM, str(free_config().port)]
    run = subprocess.run([*command, *program], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    if run.returncode == 77 or "unshare" in run.stderr:
        pytest.skip("mounting in a namespace of its own is not permitted")
    assert (run.stdout, run.returncode) == ("True False\n", 0), run.stderr
    assert "/dev/shm" in run.stderr

"""The ground truth service over a real link."""

import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base.clock import WallClock
from hal.base.errors import HalTimeoutError
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.servo.servo import Servo
from scripts.keys.certificates import add_client, make_keys
from sim_twin.ground_truth import GroundTruthClient, GroundTruthServer, read_ground_truth
from sim_twin.model.world import World
from tests.support.errors import raises
from tests.support.ports import free_tcp_port


@pytest.fixture
def bus() -> Iterator[BusConfig]:
    """A HAL process that knows no truth."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        bus = BusConfig(port=probe.getsockname()[1])
    clock = WallClock()
    servo, camera = Servo(MockArm(clock), clock), ReplayCamera(clock=clock)
    servo.connect()
    camera.connect()
    with HalServer(servo, camera, clock, bus):
        yield bus
    camera.disconnect()
    servo.disconnect()


def test_the_truth_crosses_the_link_unchanged(bus: BusConfig, world: World) -> None:
    server, here = GroundTruthServer(bus, world), read_ground_truth(world)
    with GroundTruthClient(bus) as client:
        there = client.read()
    server.close()
    assert there.object == "bottle"
    assert there.lifted_m == here.lifted_m
    np.testing.assert_array_equal(there.T_base_object, here.T_base_object)
    np.testing.assert_array_equal(there.qpos, here.qpos)


def test_without_a_twin_there_is_a_clear_error(bus: BusConfig, world: World) -> None:
    GroundTruthServer(bus, world).close()
    with GroundTruthClient(bus) as client, raises(HalTimeoutError, "no_twin"):
        client.read()


@pytest.mark.integration
@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes certificates with openssl")
def test_the_truth_crosses_a_link_with_keys(world: World, tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", [], days=2)
    viewer = add_client(tmp_path / "keys", "ann", "viewer", days=2)
    hal = BusConfig(port=free_tcp_port(), keys=str(tmp_path / "keys/hal"))
    clock = WallClock()
    servo, camera = Servo(MockArm(clock), clock), ReplayCamera(clock=clock)
    servo.connect()
    camera.connect()
    with HalServer(servo, camera, clock, hal):
        server = GroundTruthServer(hal, world)
        with GroundTruthClient(replace(hal, keys=str(viewer))) as client:
            assert client.read().object == "bottle"
        server.close()
    camera.disconnect()
    servo.disconnect()


@pytest.mark.integration
def test_a_program_that_forgets_to_close_its_server_still_ends(bus: BusConfig) -> None:
    program = (
        "from hal.bus.session import BusConfig; from sim_twin.model.scene import SceneConfig; "
        "from sim_twin.ground_truth import GroundTruthClient, GroundTruthServer; from sim_twin.model.world "
        "import World; "
        f"bus = BusConfig(port={bus.port}); server = GroundTruthServer(bus, World(SceneConfig())); "
        "client = GroundTruthClient(bus); print(client.read().object)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "bottle"

"""Fixtures for a HAL on a free loopback port."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base.clock import WallClock
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.server import HalServer
from hal.servo.servo import Servo
from hal.servo.servo_thread import ServoThread
from tests.support.hal.bus_hal import Hal, free_config


@pytest.fixture
def hal() -> Iterator[Hal]:
    clock = WallClock()
    config = free_config()
    arm, camera = MockArm(clock), ReplayCamera(clock=clock)
    servo = Servo(arm, clock, heartbeat_timeout_s=0.1)
    servo.connect()
    camera.connect()
    with ServoThread(servo, clock), HalServer(servo, camera, clock, config) as server:
        yield Hal(config, arm, camera, servo, server)
    servo.disconnect()
    camera.disconnect()


@pytest.fixture
def remote_arm(hal: Hal) -> Iterator[RemoteArm]:
    with RemoteArm(hal.config, owner="tester") as arm:
        yield arm


@pytest.fixture
def remote_camera(hal: Hal) -> Iterator[RemoteCamera]:
    with RemoteCamera(hal.config) as camera:
        yield camera

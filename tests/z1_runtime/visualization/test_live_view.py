"""Frames reach the inspector from a thread of their own, with the camera's pose, until something fails."""

from __future__ import annotations

import logging
import threading

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base import z1
from hal.base.clock import WallClock
from hal.base.messages import RgbdFrame
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.visualization.live_view import LiveView
from z1_runtime.visualization.rerun_logger import RerunLogger

Q = np.array([0.3, 1.2, -0.4, -0.3, 0.1, 1.2, -0.5])
PATIENCE_S = 20.0


class Album(RerunLogger):
    """An inspector that keeps what it is shown."""

    def __init__(self, wanted: int) -> None:
        super().__init__()
        self.seen: list[tuple[RgbdFrame, np.ndarray]] = []
        self.full = threading.Event()
        self._wanted = wanted

    def log_frame(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> None:
        self.seen.append((frame, T_base_camera))
        if len(self.seen) >= self._wanted:
            self.full.set()


@pytest.fixture
def arm():
    arm = MockArm(WallClock(), q=Q)
    arm.connect()
    return arm


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate()]


def test_frames_are_shown_with_the_camera_s_pose_and_the_thread_ends_with_the_block(arm):
    camera, album = ReplayCamera(), Album(3)
    camera.connect()
    with LiveView(camera, arm, album, rate_hz=200.0):
        assert album.full.wait(PATIENCE_S)
    assert "frame tap" not in threads()
    sequences = [frame.sequence for frame, _ in album.seen]
    assert sequences == sorted(set(sequences))
    for _, T_base_camera in album.seen:
        np.testing.assert_allclose(T_base_camera, Kinematics().flange(Q[:6]) @ z1.T_FLANGE_CAMERA, atol=1e-6)


def test_a_camera_that_fails_ends_the_showing_with_a_warning_and_nothing_else(arm, caplog):
    camera, album = ReplayCamera(loop=False), Album(1)  # never connected
    tap = LiveView(camera, arm, album, rate_hz=200.0)
    with caplog.at_level(logging.WARNING), tap:
        tap._thread.join(PATIENCE_S)
        assert not tap._thread.is_alive()
    assert album.seen == []
    assert "no more frames are shown: the replay camera is not connected" in caplog.text


def test_an_arm_that_fails_ends_the_showing_too(caplog):
    camera, album = ReplayCamera(), Album(1)
    camera.connect()
    tap = LiveView(camera, MockArm(WallClock()), album, rate_hz=200.0)
    with caplog.at_level(logging.WARNING), tap:
        tap._thread.join(PATIENCE_S)
        assert not tap._thread.is_alive()
    assert "the mock arm is not connected" in caplog.text

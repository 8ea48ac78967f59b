"""Frames reach the logger from a thread of their own, with the camera's pose, until a device fails."""

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
TIMEOUT_S = 20.0


class FrameList(RerunLogger):
    """A logger that keeps its frames."""

    def __init__(self, wanted: int) -> None:
        super().__init__()
        self.logged: list[tuple[RgbdFrame, np.ndarray]] = []
        self.full = threading.Event()
        self._wanted = wanted

    def log_frame(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> None:
        self.logged.append((frame, T_base_camera))
        if len(self.logged) >= self._wanted:
            self.full.set()


@pytest.fixture
def arm():
    arm = MockArm(WallClock(), q=Q)
    arm.connect()
    return arm


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate()]


def test_frames_are_logged_with_the_camera_pose_and_the_thread_ends_with_the_block(arm):
    camera, frames = ReplayCamera(), FrameList(3)
    camera.connect()
    with LiveView(camera, arm, frames, rate_hz=200.0):
        assert frames.full.wait(TIMEOUT_S)
    assert "live view" not in threads()
    sequences = [frame.sequence for frame, _ in frames.logged]
    assert sequences == sorted(set(sequences))
    for _, T_base_camera in frames.logged:
        np.testing.assert_allclose(T_base_camera, Kinematics().flange(Q[:6]) @ z1.T_FLANGE_CAMERA, atol=1e-6)


def test_camera_failure_ends_the_view_with_a_warning_only(arm, caplog):
    camera, frames = ReplayCamera(loop=False), FrameList(1)  # never connected
    view = LiveView(camera, arm, frames, rate_hz=200.0)
    with caplog.at_level(logging.WARNING), view:
        view._thread.join(TIMEOUT_S)
        assert not view._thread.is_alive()
    assert frames.logged == []
    assert "the live view ends: the replay camera is not connected" in caplog.text


def test_arm_failure_ends_the_view_too(caplog):
    camera, frames = ReplayCamera(), FrameList(1)
    camera.connect()
    view = LiveView(camera, MockArm(WallClock()), frames, rate_hz=200.0)
    with caplog.at_level(logging.WARNING), view:
        view._thread.join(TIMEOUT_S)
        assert not view._thread.is_alive()
    assert "the mock arm is not connected" in caplog.text

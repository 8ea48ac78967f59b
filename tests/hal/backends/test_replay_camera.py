"""Recorded frames: saved, loaded and replayed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.backends.replay_camera import ReplayCamera, load_frames, make_demo_frames, save_frames
from hal.base.clock import ManualClock
from hal.base.errors import CameraError, HalTimeoutError
from tests.support.errors import raises


def test_frames_survive_the_file(tmp_path: Path) -> None:
    frames = [replace(f, ground_truth_mask=f.depth_m < 0.4) for f in make_demo_frames()]
    save_frames(tmp_path / "run.npz", frames)
    loaded = load_frames(tmp_path / "run.npz")
    assert len(loaded) == len(frames)
    for before, after in zip(frames, loaded, strict=True):
        assert (before.colour == after.colour).all()
        assert (before.depth_m == after.depth_m).all()
        assert after.ground_truth_mask is not None
        assert (before.ground_truth_mask == after.ground_truth_mask).all()
        assert (before.intrinsics, before.stamp_s, before.sequence) == (
            after.intrinsics,
            after.stamp_s,
            after.sequence,
        )


def test_a_file_without_a_recording_is_rejected_with_its_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with raises(CameraError, "not_a_recording") as caught:
        load_frames(tmp_path / "other.npz")
    assert "other.npz" in str(caught.value)
    assert "save_frames()" in str(caught.value)
    with pytest.raises(FileNotFoundError):
        load_frames(tmp_path / "missing.npz")


def test_a_recording_is_replayed_at_its_own_rate_and_repeated() -> None:
    clock = ManualClock(3.0)
    frames = make_demo_frames(3)
    camera = ReplayCamera(frames, clock=clock)
    camera.connect()
    played = [camera.wait_for_frame(1.0) for _ in range(7)]
    assert [f.sequence for f in played] == list(range(7))
    assert [f.stamp_s for f in played] == pytest.approx([3.0 + i / 30 for i in range(7)])
    assert all((f.colour == frames[i % 3].colour).all() for i, f in enumerate(played))


def test_frames_without_a_wait_are_missed_as_with_a_real_camera() -> None:
    clock = ManualClock()
    camera = ReplayCamera(clock=clock)
    camera.connect()
    camera.wait_for_frame(1.0)
    clock.advance(0.1 + 0.001)
    assert camera.wait_for_frame(1.0).sequence == 4


def test_a_recording_that_does_not_loop_ends_with_a_timeout() -> None:
    clock = ManualClock()
    camera = ReplayCamera(make_demo_frames(2), clock=clock, loop=False)
    camera.connect()
    camera.wait_for_frame(1.0)
    camera.wait_for_frame(1.0)
    with raises(HalTimeoutError, "recording_ended"):
        camera.wait_for_frame(0.5)


def test_an_empty_recording_is_rejected() -> None:
    with raises(CameraError, "no_frames"):
        ReplayCamera([])


def test_the_built_in_scene_is_a_ball_above_a_plane() -> None:
    depth_m = make_demo_frames(1)[0].depth_m
    assert depth_m.max() == pytest.approx(0.5)
    assert depth_m.min() == pytest.approx(0.30, abs=0.001)

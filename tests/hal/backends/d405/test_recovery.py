"""Recovery steps of a camera without frames, and the conversion of its stamps."""

from __future__ import annotations

import pytest

from hal.backends.d405.recovery import RecoveryPolicy, RecoveryStep, StampConverter


def test_the_steps_are_restart_reset_and_search() -> None:
    policy = RecoveryPolicy(1.0)
    steps = [policy.on_silence(0.25) for _ in range(20)]
    assert [step for step in steps if step] == [
        RecoveryStep.RESTART,
        RecoveryStep.RESET,
        RecoveryStep.SEARCH,
        RecoveryStep.SEARCH,
        RecoveryStep.SEARCH,
    ]
    assert steps[:3] == [None] * 3


def test_a_frame_resets_the_recovery() -> None:
    policy = RecoveryPolicy(1.0)
    assert policy.on_silence(1.0) is RecoveryStep.RESTART
    policy.on_silence(0.9)
    policy.on_frame()
    assert policy.step is None
    assert policy.on_silence(0.9) is None
    assert policy.on_silence(0.2) is RecoveryStep.RESTART


def test_a_camera_off_the_bus_is_searched_for_and_reset_if_it_returns_without_frames() -> None:
    policy = RecoveryPolicy(1.0)
    policy.on_silence(1.0)
    policy.on_lost()
    assert policy.on_silence(1.0) is RecoveryStep.SEARCH
    policy.on_found()
    assert policy.on_silence(1.0) is RecoveryStep.RESET


def feed(converter: StampConverter, frames: int, *, jump_s: float = 0.0, start_s: float = 0.0):
    """Convert the stamps of frames of 30 Hz that are 20 ms old, with the device's time off by `jump_s`."""
    stamps = []
    for i in range(frames):
        taken_s = start_s + i / 30
        now_s = start_s + i / 30 + 0.02
        stamps.append((converter.convert(1e9 + taken_s + jump_s, 1e9, now_s), now_s))
    return stamps


def test_stamps_are_the_devices_time_by_the_clock() -> None:
    for i, (stamp_s, _) in enumerate(feed(StampConverter(0.5), 5)):
        assert stamp_s == pytest.approx(i / 30, abs=1e-6)


def test_no_stamp_is_in_the_future() -> None:
    (stamp_s, now_s), *_ = feed(StampConverter(0.5), 1, jump_s=0.05)
    assert stamp_s == now_s


@pytest.mark.parametrize("jump_s", [-3600.0, -2.0, 2.0, 3600.0])
def test_a_jump_of_the_systems_time_costs_a_few_frames_and_not_the_camera(jump_s: float) -> None:
    converter = StampConverter(0.5)
    feed(converter, 10)
    after = feed(converter, 10, jump_s=jump_s, start_s=1.0)
    used = [(stamp_s, now_s) for stamp_s, now_s in after if stamp_s is not None]
    assert 5 <= len(used) < 10
    assert all(0.0 <= now_s - stamp_s < 0.06 for stamp_s, now_s in used)


def test_frames_delayed_in_a_queue_are_never_accepted() -> None:
    converter = StampConverter(0.5)
    feed(converter, 3)
    late = [converter.convert(1e9 + 1.0 + i / 30, 1e9, 11.0 + 0.002 * i) for i in range(20)]
    assert late == [None] * 20


def test_a_repeated_time_stamp_is_never_accepted() -> None:
    converter = StampConverter(0.5)
    feed(converter, 3)
    assert [converter.convert(1e9 + 0.1, 1e9, 5.0 + i / 30) for i in range(20)] == [None] * 20

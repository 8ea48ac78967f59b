"""What is tried when a camera falls silent, and what is made of its stamps."""

from __future__ import annotations

import pytest

from hal.backends.d405.recovery import RecoveryPolicy, RecoveryStep, StampConverter


def test_the_rungs_are_restart_reset_and_search() -> None:
    ladder = RecoveryPolicy(1.0)
    climbed = [ladder.silent(0.25) for _ in range(20)]
    assert [rung for rung in climbed if rung] == [RecoveryStep.RESTART, RecoveryStep.RESET, RecoveryStep.SEARCH, RecoveryStep.SEARCH, RecoveryStep.SEARCH]
    assert climbed[:3] == [None] * 3


def test_a_frame_puts_one_back_on_the_ground() -> None:
    ladder = RecoveryPolicy(1.0)
    assert ladder.silent(1.0) is RecoveryStep.RESTART
    ladder.silent(0.9)
    ladder.heard()
    assert ladder.rung is None
    assert ladder.silent(0.9) is None
    assert ladder.silent(0.2) is RecoveryStep.RESTART


def test_a_camera_off_the_bus_is_only_looked_for_and_reset_if_it_comes_back_silent() -> None:
    ladder = RecoveryPolicy(1.0)
    ladder.silent(1.0)
    ladder.lost()
    assert ladder.silent(1.0) is RecoveryStep.SEARCH
    ladder.found()
    assert ladder.silent(1.0) is RecoveryStep.RESET


def feed(keeper: StampConverter, frames: int, *, jump_s: float = 0.0, start_s: float = 0.0):
    """Give frames of 30 Hz that are 20 ms old, with the device's time off by `jump_s`."""
    stamps = []
    for i in range(frames):
        taken_s = start_s + i / 30
        now_s = start_s + i / 30 + 0.02
        stamps.append((keeper.stamp(1e9 + taken_s + jump_s, 1e9, now_s), now_s))
    return stamps


def test_stamps_are_the_devices_time_by_the_clock() -> None:
    for i, (stamp_s, _) in enumerate(feed(StampConverter(0.5), 5)):
        assert stamp_s == pytest.approx(i / 30, abs=1e-6)


def test_no_frame_is_of_the_future() -> None:
    (stamp_s, now_s), *_ = feed(StampConverter(0.5), 1, jump_s=0.05)
    assert stamp_s == now_s


@pytest.mark.parametrize("jump_s", [-3600.0, -2.0, 2.0, 3600.0])
def test_a_jump_of_the_systems_time_costs_a_few_frames_and_not_the_camera(jump_s: float) -> None:
    keeper = StampConverter(0.5)
    feed(keeper, 10)
    after = feed(keeper, 10, jump_s=jump_s, start_s=1.0)
    used = [(stamp_s, now_s) for stamp_s, now_s in after if stamp_s is not None]
    assert 5 <= len(used) < 10
    assert all(0.0 <= now_s - stamp_s < 0.06 for stamp_s, now_s in used)


def test_frames_that_waited_in_a_queue_are_never_believed() -> None:
    keeper = StampConverter(0.5)
    feed(keeper, 3)
    late = [keeper.stamp(1e9 + 1.0 + i / 30, 1e9, 11.0 + 0.002 * i) for i in range(20)]
    assert late == [None] * 20


def test_the_same_time_again_and_again_is_never_believed() -> None:
    keeper = StampConverter(0.5)
    feed(keeper, 3)
    assert [keeper.stamp(1e9 + 0.1, 1e9, 5.0 + i / 30) for i in range(20)] == [None] * 20

import pytest

from hal.base.z1 import CONTROL_PERIOD_S
from sim_twin.backends import TwinClock
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World


@pytest.mark.integration
def test_sleeping_steps_the_world_and_calls_every_tick_first() -> None:
    world = World(SceneConfig(object="cylinder"))
    clock = TwinClock(world)
    seen: list[float] = []
    clock.call_every_tick(lambda: seen.append(clock.now_s()))
    clock.sleep_until(0.01)
    assert seen == [step * CONTROL_PERIOD_S for step in range(5)]
    assert clock.now_s() == 5 * CONTROL_PERIOD_S


def test_time_is_a_whole_number_of_periods_however_it_was_slept() -> None:
    clock = TwinClock(World(SceneConfig(object="cylinder")))
    t = 0.0
    for _ in range(300):
        t += CONTROL_PERIOD_S  # the caller's rounding adds up, the clock's does not
        clock.sleep_until(t)
    assert clock.now_s() == 300 * CONTROL_PERIOD_S
    clock.sleep_until(0.1)
    assert clock.now_s() == 300 * CONTROL_PERIOD_S


def test_a_tick_function_that_sleeps_is_rejected() -> None:
    clock = TwinClock(World(SceneConfig(object="cylinder")))
    clock.call_every_tick(lambda: clock.sleep_until(1.0))
    with pytest.raises(RuntimeError):
        clock.sleep_until(0.1)

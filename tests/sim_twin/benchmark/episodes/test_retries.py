from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from sim_twin.benchmark.episodes import episode
from sim_twin.benchmark.episodes.episode import run_scenario
from sim_twin.benchmark.episodes.execution import EpisodeRobot, Mode, Outcome, capture
from sim_twin.benchmark.episodes.methods import METHODS
from sim_twin.benchmark.episodes.scenarios import Scenario
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import make_grasp_selector

SCENARIO = Scenario(object="cylinder", distance="mid", lateral="centre", pitch_deg=0.0)
MVB = METHODS["mvb"]


@pytest.fixture(scope="module")
def selector():
    return make_grasp_selector(RuntimeConfig(generator="antipodal", detector="tabletop", n_candidates=300))


class Grasped:
    """Keeps what was executed, and lets the first grasps go to where the object is not."""

    def __init__(self, monkeypatch, missing: int) -> None:
        self.plans, self.heights_m, self.starts = [], [], []
        real = EpisodeRobot.execute

        def execute(robot, plan):
            self.plans.append(plan)
            self.starts.append(robot.world.read_arm()[0])
            if len(self.plans) > missing:
                return real(robot, plan)
            away = robot.world.data.qpos
            away[z1.N_JOINTS + 1] += 0.12
            outcome = real(robot, plan)
            self.heights_m.append(robot.world.lifted_m())
            return outcome

        monkeypatch.setattr(EpisodeRobot, "execute", execute)


@pytest.mark.integration
def test_after_a_miss_the_object_is_found_where_it_then_is(selector, monkeypatch):
    grasped = Grasped(monkeypatch, missing=1)
    (row,) = run_scenario(SCENARIO, [MVB], lambda *_: selector, top_k=3)
    assert row["modes"] == ["missed", "success"]
    assert row["success_after"] == [False, True, True]
    assert (row["attempts"], row["success"], row["success_top1"], row["top_k"]) == (2, True, False, 3)
    first, second = (plan.T_base_grasp[:3, 3] for plan in grasped.plans)
    assert second[1] - first[1] == pytest.approx(0.12, abs=0.03)
    np.testing.assert_allclose(grasped.starts[1], [*z1.Q_HOME, selector.config.jaw_home], atol=5e-3)


@pytest.mark.integration
def test_there_are_no_more_attempts_than_asked_for(selector, monkeypatch):
    grasped = Grasped(monkeypatch, missing=9)
    (row,) = run_scenario(SCENARIO, [MVB], lambda *_: selector, top_k=1)
    assert len(grasped.plans) == row["attempts"] == 1
    assert row["success_after"] == [False]
    assert row["given_up"] == ""


@pytest.mark.integration
def test_each_attempt_has_candidates_of_its_own_and_the_row_is_of_the_last(selector, monkeypatch):
    seeds = []

    def make(_, seed):
        seeds.append(seed)
        return selector

    outcomes = iter([Mode.MISSED, Mode.DROPPED, Mode.SLIPPED])
    monkeypatch.setattr(EpisodeRobot, "execute", lambda *_: Outcome(mode=next(outcomes)))
    monkeypatch.setattr(EpisodeRobot, "withdraw", lambda *_: None)
    (row,) = run_scenario(SCENARIO, [MVB], make, top_k=3)
    assert row["modes"] == ["missed", "dropped", "slipped"]
    assert row["mode"] == "slipped"
    assert len(set(seeds)) == 3


@pytest.mark.integration
def test_an_object_that_has_gone_ends_the_episode_with_the_reason(selector, monkeypatch):
    monkeypatch.setattr(EpisodeRobot, "execute", lambda *_: Outcome(mode=Mode.KNOCKED))
    real = episode.occlude
    covered = []

    def occlude(frame, share, seed):
        covered.append(frame)
        return real(frame, share if len(covered) == 1 else 0.99, seed)

    monkeypatch.setattr(episode, "occlude", occlude)
    (row,) = run_scenario(SCENARIO, [MVB], lambda *_: selector, top_k=3)
    assert (row["attempts"], row["mode"]) == (1, "object knocked")
    assert row["given_up"].startswith("no detection: ")


@pytest.mark.integration
@pytest.mark.parametrize("mode", [Mode.TABLE_COLLISION, Mode.STOPPED])
def test_what_would_stop_a_real_arm_is_not_tried_again(selector, monkeypatch, mode):
    monkeypatch.setattr(EpisodeRobot, "execute", lambda *_: Outcome(mode=mode))
    (row,) = run_scenario(SCENARIO, [MVB], lambda *_: selector, top_k=3)
    assert (row["attempts"], row["modes"]) == (1, [mode.value])


@pytest.mark.integration
def test_what_slipped_but_hangs_is_put_down_before_the_jaws_open(selector):
    frame, q = capture(SCENARIO.scene())
    plan = selector.select(frame, q).plan
    with EpisodeRobot(SCENARIO.scene(), selector.kinematics) as robot:
        outcome = robot.execute(plan)
        assert outcome.mode is Mode.SUCCESS
        assert robot.world.lifted_m() > 0.05
        robot.withdraw(plan, replace(outcome, mode=Mode.SLIPPED), -1.0)
        assert robot.world.lifted_m() == pytest.approx(0.0, abs=2e-3)
        assert robot.world.T_base_object()[2, 2] > 0.99
        np.testing.assert_allclose(robot.world.read_arm()[0], [*z1.Q_HOME, -1.0], atol=5e-3)

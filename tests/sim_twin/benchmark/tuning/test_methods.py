"""A method of the benchmark takes its numbers from a scoring file; and `full` applies the settings it is given."""

from dataclasses import replace

import numpy as np
import pytest

from hal.base import z1
from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.methods import METHODS, file_name, parse_method
from sim_twin.benchmark.episodes.shared_observation import SharedObservation
from sim_twin.benchmark.results.store import Store
from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig
from z1_runtime.factory import draw_can, make_grasp_selector
from z1_runtime.grasping.ranking import Ranking, Scoring, ScoringError, ScoringHead, measure_features, save_scoring
from z1_runtime.tasks.grasp_selection import StageTimes

pytestmark = pytest.mark.integration

HEAD = ScoringHead(features=("above_m",), mean=(0.0,), scale=(0.01,), coefficients=(1.0,), intercept=0.0)
Q = np.append(z1.Q_HOME, -1.0)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "scoring.yaml"
    save_scoring(
        Scoring(mvb=Ranking(k_faces=1, alpha=0.5, hard_filter=False, head=HEAD), full=Ranking(box_method="upright")),
        path,
    )
    return path


@pytest.fixture(scope="module")
def selector():
    return make_grasp_selector(RuntimeConfig(detector="tabletop", n_candidates=200))


@pytest.fixture(scope="module")
def seen(selector):
    frame = draw_can(selector.kinematics.flange(z1.Q_HOME) @ z1.T_FLANGE_CAMERA)
    return SharedObservation.by(selector, frame, Q, StageTimes())


def order(text, seen, selector):
    best_first, left = parse_method(text).order(seen, selector, StageTimes())
    return best_first.ranked, left[best_first.ranked.indices].tolist()


def test_a_scoring_file_gives_each_method_its_own_numbers(file):
    mvb, full = parse_method(f"mvb:scoring={file}"), parse_method(f"full:scoring={file}")
    assert (mvb.k, mvb.alpha, mvb.hard_filter, mvb.head) == (1, 0.5, False, HEAD)
    assert (full.k, full.box, full.head) == (2, "upright", None)
    assert parse_method(f"mvb:k=4,scoring={file}").k == parse_method(f"mvb:scoring={file},k=4").k == 4


def test_invalid_methods_are_rejected(tmp_path):
    with pytest.raises(ScoringError):
        parse_method(f"mvb:scoring={tmp_path / 'nowhere.yaml'}")
    with raises(InvalidValueError, "method_value"):
        parse_method("mvb:k=7")
    with raises(InvalidValueError, "unknown_setting"):
        parse_method("full:collision_filter=no")
    with raises(InvalidValueError, "unknown_setting"):
        parse_method("vanilla:k=2")


def test_full_uses_its_settings_and_else_the_configurations(seen, selector):
    configured, one = METHODS["full"].ranking(selector.ranking), parse_method("full:k=1").ranking(selector.ranking)
    assert configured == selector.ranking
    assert one == replace(selector.ranking, k_faces=1)
    assert len(order("full:k=1", seen, selector)[0]) < len(order("full", seen, selector)[0])
    assert order("full:k=2", seen, selector)[1] == order("full", seen, selector)[1]


def test_a_head_orders_the_grasps_of_mvb_by_its_features(seen, selector, file):
    best_first, _ = parse_method(f"mvb:scoring={file},k=2,hard_filter=yes").order(seen, selector, StageTimes())
    heights = measure_features(best_first.candidates)[:, 3]
    assert (np.diff(heights) <= 1e-9).all()
    assert sorted(order(f"mvb:scoring={file},k=2,hard_filter=yes", seen, selector)[1]) == sorted(
        order("mvb", seen, selector)[1]
    )


def test_what_is_below_a_threshold_comes_last_in_its_old_order(seen, selector):
    plain, before = order("mvb", seen, selector)
    cut = float(np.median(plain.grasps.scores))
    ranked, after = order(f"mvb:min_score={cut}", seen, selector)
    wanted = {index: score >= cut for index, score in zip(before, plain.grasps.scores, strict=True)}
    assert after == sorted(before, key=lambda index: not wanted[index])
    assert not all(wanted.values())
    assert (np.diff(ranked.scores) <= 0.0).all()


def test_rows_of_a_method_with_a_path_in_its_name_and_of_many_variants_can_be_kept(tmp_path):
    store = Store(tmp_path, resume=False)
    names = ["mvb:scoring=out/tune/scoring.yaml", *(f"mvb:alpha={n / 100}" for n in range(40))]
    store.add([{"scenario": "box-s1", "method": name} for name in names])
    assert store.done() == {("box-s1", name) for name in names}
    assert "/" not in file_name(names[0])

"""What is planted in made-up rows is found, and noise is not believed."""

import numpy as np
import pytest

from sim_twin.benchmark.tuning.folds import folds_of
from sim_twin.benchmark.tuning.head import fit_head
from sim_twin.benchmark.tuning.rows import Samples, samples_of
from sim_twin.benchmark.tuning.thresholds import fit_threshold
from sim_twin.benchmark.tuning.variants import choose, said, variants_of
from tests.support.tune_episodes import episode, scenarios
from z1_runtime.grasping.features import FEATURES
from z1_runtime.grasping.ranking import Ranking

pytest.importorskip("sklearn", reason="uv sync --inexact --extra tune")
POSES = np.array([f"pose{n // 2}" for n in range(120)])


def test_no_pose_stands_on_both_sides_of_a_fold_and_each_is_judged_once():
    folds = list(folds_of(POSES))
    assert len(folds) == 5
    assert sorted(np.concatenate([test for _, test in folds])) == list(range(len(POSES)))
    assert not any(set(POSES[train]) & set(POSES[test]) for train, test in folds)
    assert list(folds_of(["one"] * 3)) == []


def both(outcomes):
    return {"top1": outcomes, "fallthrough": outcomes}


def test_the_variant_with_the_most_successes_is_chosen_and_the_hand_set_one_among_equals():
    keys = [f"p{n}-s1" for n in range(40)]
    outcomes = {
        "mvb": {key: n % 2 == 0 for n, key in enumerate(keys)},
        "mvb:k=3": {key: n % 4 != 0 for n, key in enumerate(keys)},
        "mvb:k=1": {key: n % 2 == 1 for n, key in enumerate(keys)},
    }
    best = choose(both(outcomes), "top1", list(outcomes), "mvb")
    assert best.chosen == "mvb:k=3"
    assert best.successes["top1"] == {"mvb": 20, "mvb:k=1": 20, "mvb:k=3": 30}
    assert set(best.by_fold) == {"mvb:k=3"}
    assert best.cross_validated == 30
    assert choose(both(outcomes), "top1", ["mvb:k=1", "mvb"], "mvb").chosen == "mvb"


def test_variants_are_compared_on_the_scenarios_that_all_of_them_have():
    outcomes = {"mvb": {"a-s1": False, "b-s1": False}, "mvb:k=3": {"b-s1": True, "c-s1": True}}
    found = choose(both(outcomes), "top1", list(outcomes), "mvb")
    assert found.scenarios == 1
    assert found.successes["top1"] == {"mvb": 0, "mvb:k=3": 1}


def test_only_what_a_scoring_can_express_is_a_variant():
    names = ["full", "mvb:k=3", "mvb", "vanilla", "mvb:collision_filter=no"]
    assert list(variants_of("mvb", names)) == ["mvb", "mvb:k=3"]
    assert said(Ranking(hard_filter=False, min_score=0.25)) == "k=2 α=0.85 box=pca no hard filter s≥0.25"


def test_a_planted_threshold_is_found_and_holds():
    rng = np.random.default_rng(1)
    values = rng.uniform(size=len(POSES))
    found = fit_threshold(values, values > 0.3 + rng.normal(0.0, 0.02, len(POSES)), POSES)
    assert found is not None
    assert found.value == pytest.approx(0.3, abs=0.05)
    assert found.holds
    assert found.below[0] / found.below[1] < 0.3
    assert found.above[0] / found.above[1] > 0.9
    assert found.below[1] + found.above[1] == len(POSES)


def test_a_threshold_in_noise_does_not_hold():
    rng = np.random.default_rng(2)
    believed = 0
    for _ in range(40):
        found = fit_threshold(rng.uniform(size=len(POSES)), rng.uniform(size=len(POSES)) < 0.6, POSES)
        believed += found is not None and found.holds
    assert believed <= 6  # 2 of 40 at 0.05


def test_where_more_is_worse_or_all_ended_alike_there_is_no_threshold():
    values = np.linspace(0.0, 1.0, len(POSES))
    assert fit_threshold(values, values < 0.5, POSES) is None
    assert fit_threshold(values, np.ones(len(POSES), bool), POSES) is None
    assert fit_threshold(np.full(len(POSES), np.nan), values > 0.5, POSES) is None


@pytest.fixture(scope="module")
def planted() -> Samples:
    return samples_of([episode(s, "mvb", n % 3 != 0, candidate=n) for n, s in enumerate(scenarios(1, 2))], "top1")


def test_a_head_finds_the_feature_that_tells(planted):
    report = fit_head(planted)
    assert report is not None
    assert report.helps
    assert report.skill.grasps == len(planted) == 162
    assert report.skill.auc > 0.95
    weights = dict(zip(report.head.features, report.head.coefficients, strict=True))
    assert max(weights, key=lambda name: abs(weights[name])) == "down"
    assert weights["down"] < 0.0
    assert report.alone["down"] < 0.05
    assert set(report.objects) == {"bottle", "box", "cylinder"}
    assert min(skill.auc for skill in report.objects.values()) > 0.9
    assert sum(n for *_, n in report.bins) == 162
    assert report.bins[0][1] / report.bins[0][2] < 0.3
    assert report.bins[-1][1] / report.bins[-1][2] > 0.9


def test_the_head_that_is_written_is_the_regression_that_was_fitted(planted):
    from sklearn.linear_model import LogisticRegression

    report = fit_head(planted)
    assert report is not None
    z = (planted.measured - planted.measured.mean(axis=0)) / planted.measured.std(axis=0)
    told = report.head.probability(planted.measured)
    fits = [LogisticRegression(C=c, max_iter=2000).fit(z, planted.worked) for c in (0.01, 0.1, 1.0, 10.0)]
    assert min(np.abs(fit.predict_proba(z)[:, 1] - told).max() for fit in fits) < 1e-4


def test_a_head_fitted_to_noise_does_not_help(planted):
    rng = np.random.default_rng(5)
    noise = Samples(
        measured=rng.normal(size=planted.measured.shape),
        worked=planted.worked,
        poses=planted.poses,
        objects=planted.objects,
    )
    report = fit_head(noise)
    assert report is not None
    assert not report.helps


def test_a_feature_that_never_varies_is_left_out(planted):
    measured = planted.measured.copy()
    measured[:, list(FEATURES).index("level")] = 1.0
    report = fit_head(Samples(measured=measured, worked=planted.worked, poses=planted.poses, objects=planted.objects))
    assert report is not None
    assert "level" not in report.head.features
    assert len(report.head.features) == len(FEATURES) - 1


def test_too_few_failures_make_no_head(planted):
    few = planted[np.flatnonzero(planted.worked | (np.arange(len(planted)) < 20))]
    assert fit_head(few) is None

"""Fits find a planted effect in synthetic rows, and reject noise."""

import numpy as np
import pytest

from sim_twin.benchmark.tuning.folds import make_folds
from sim_twin.benchmark.tuning.head import fit_head
from sim_twin.benchmark.tuning.logged_episodes import Samples, extract_samples
from sim_twin.benchmark.tuning.thresholds import fit_threshold
from sim_twin.benchmark.tuning.variants import find_variants, format_ranking, select_variant
from tests.support.tune_episodes import episode, scenarios
from z1_runtime.grasping.ranking import FEATURES, Ranking

pytest.importorskip("sklearn", reason="uv sync --inexact --extra tune")
POSES = np.array([f"pose{n // 2}" for n in range(120)])


def test_no_pose_is_on_both_sides_of_a_fold_and_each_is_evaluated_once():
    folds = list(make_folds(POSES))
    assert len(folds) == 5
    assert sorted(np.concatenate([test for _, test in folds])) == list(range(len(POSES)))
    assert not any(set(POSES[train]) & set(POSES[test]) for train, test in folds)
    assert list(make_folds(["one"] * 3)) == []


def both(collect_outcomes):
    return {"top1": collect_outcomes, "fallthrough": collect_outcomes}


def test_the_variant_with_the_most_successes_is_chosen_and_the_hand_set_one_among_equals():
    keys = [f"p{n}-s1" for n in range(40)]
    collect_outcomes = {
        "mvb": {key: n % 2 == 0 for n, key in enumerate(keys)},
        "mvb:k=3": {key: n % 4 != 0 for n, key in enumerate(keys)},
        "mvb:k=1": {key: n % 2 == 1 for n, key in enumerate(keys)},
    }
    best = select_variant(both(collect_outcomes), "top1", list(collect_outcomes), "mvb")
    assert best.chosen == "mvb:k=3"
    assert best.successes["top1"] == {"mvb": 20, "mvb:k=1": 20, "mvb:k=3": 30}
    assert set(best.by_fold) == {"mvb:k=3"}
    assert best.cross_validated == 30
    assert select_variant(both(collect_outcomes), "top1", ["mvb:k=1", "mvb"], "mvb").chosen == "mvb"


def test_variants_are_compared_on_the_scenarios_that_all_of_them_have():
    collect_outcomes = {"mvb": {"a-s1": False, "b-s1": False}, "mvb:k=3": {"b-s1": True, "c-s1": True}}
    found = select_variant(both(collect_outcomes), "top1", list(collect_outcomes), "mvb")
    assert found.scenarios == 1
    assert found.successes["top1"] == {"mvb": 0, "mvb:k=3": 1}


def test_only_what_a_scoring_can_express_is_a_variant():
    names = ["full", "mvb:k=3", "mvb", "vanilla", "mvb:collision_filter=no"]
    assert list(find_variants("mvb", names)) == ["mvb", "mvb:k=3"]
    assert format_ranking(Ranking(hard_filter=False, min_score=0.25)) == "k=2 α=0.85 box=pca no hard filter s≥0.25"


def test_a_planted_threshold_is_found_and_holds():
    rng = np.random.default_rng(1)
    values = rng.uniform(size=len(POSES))
    found = fit_threshold(values, values > 0.3 + rng.normal(0.0, 0.02, len(POSES)), POSES)
    assert found is not None
    assert found.value == pytest.approx(0.3, abs=0.05)
    assert found.is_significant
    assert found.below[0] / found.below[1] < 0.3
    assert found.above[0] / found.above[1] > 0.9
    assert found.below[1] + found.above[1] == len(POSES)


def test_a_threshold_in_noise_does_not_hold():
    rng = np.random.default_rng(2)
    accepted = 0
    for _ in range(40):
        found = fit_threshold(rng.uniform(size=len(POSES)), rng.uniform(size=len(POSES)) < 0.6, POSES)
        accepted += found is not None and found.is_significant
    assert accepted <= 6  # 2 of 40 at 0.05


def test_where_more_is_worse_or_all_ended_alike_there_is_no_threshold():
    values = np.linspace(0.0, 1.0, len(POSES))
    assert fit_threshold(values, values < 0.5, POSES) is None
    assert fit_threshold(values, np.ones(len(POSES), bool), POSES) is None
    assert fit_threshold(np.full(len(POSES), np.nan), values > 0.5, POSES) is None


@pytest.fixture(scope="module")
def planted() -> Samples:
    return extract_samples([episode(s, "mvb", n % 3 != 0, candidate=n) for n, s in enumerate(scenarios(1, 2))], "top1")


@pytest.mark.integration
def test_a_head_finds_the_informative_feature(planted):
    report = fit_head(planted)
    assert report is not None
    assert report.beats_base_rate
    assert report.skill.grasps == len(planted) == 162
    assert report.skill.auc > 0.95
    weights = dict(zip(report.head.features, report.head.coefficients, strict=True))
    assert max(weights, key=lambda name: abs(weights[name])) == "down"
    assert weights["down"] < 0.0
    assert report.single_feature_auc["down"] < 0.05
    assert set(report.objects) == {"bottle", "box", "cylinder"}
    assert min(skill.auc for skill in report.objects.values()) > 0.9
    assert sum(n for *_, n in report.bins) == 162
    assert report.bins[0][1] / report.bins[0][2] < 0.3
    assert report.bins[-1][1] / report.bins[-1][2] > 0.9


@pytest.mark.integration
def test_the_head_that_is_written_is_the_regression_that_was_fitted(planted):
    from sklearn.linear_model import LogisticRegression

    report = fit_head(planted)
    assert report is not None
    z = (planted.features - planted.features.mean(axis=0)) / planted.features.std(axis=0)
    predictions = report.head.probability(planted.features)
    fits = [LogisticRegression(C=c, max_iter=2000).fit(z, planted.success) for c in (0.01, 0.1, 1.0, 10.0)]
    assert min(np.abs(fit.predict_proba(z)[:, 1] - predictions).max() for fit in fits) < 1e-4


@pytest.mark.integration
def test_a_head_fitted_to_noise_does_not_help(planted):
    rng = np.random.default_rng(5)
    noise = Samples(
        features=rng.normal(size=planted.features.shape),
        success=planted.success,
        poses=planted.poses,
        objects=planted.objects,
    )
    report = fit_head(noise)
    assert report is not None
    assert not report.beats_base_rate


@pytest.mark.integration
def test_a_feature_that_never_varies_is_left_out(planted):
    features = planted.features.copy()
    features[:, list(FEATURES).index("level")] = 1.0
    report = fit_head(Samples(features=features, success=planted.success, poses=planted.poses, objects=planted.objects))
    assert report is not None
    assert "level" not in report.head.features
    assert len(report.head.features) == len(FEATURES) - 1


def test_too_few_failures_make_no_head(planted):
    few = planted[np.flatnonzero(planted.success | (np.arange(len(planted)) < 20))]
    assert fit_head(few) is None

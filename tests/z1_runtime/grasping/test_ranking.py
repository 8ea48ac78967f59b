"""Scoring files: round trip, rejection of unusable ones, and rankings by their numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.support.errors import raises
from z1_runtime.config import RuntimeConfig, ranking_of
from z1_runtime.grasping.ranking import (
    FEATURES,
    Ranking,
    Scoring,
    ScoringError,
    ScoringHead,
    load_scoring,
    save_scoring,
)

HEAD = ScoringHead(
    features=("down", "generator"), mean=(0.1, 0.5), scale=(0.2, 0.25), coefficients=(-1.0, 2.0), intercept=0.5
)
FITTED = Scoring(
    mvb=Ranking(k_faces=3, alpha=0.25, min_score=0.4),
    full=Ranking(box_method="upright", head=HEAD, min_alignment=0.2),
    tuned=("mvb", "full"),
    evidence={"held out": [2], "words": "größer"},
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    save_scoring(FITTED, tmp_path / "scoring.yaml")
    return tmp_path / "scoring.yaml"


def measured(n: int, **columns: float | list[float]) -> np.ndarray:
    values = np.zeros((n, len(FEATURES)))
    for name, value in columns.items():
        values[:, list(FEATURES).index(name)] = value
    return values


def test_a_saved_scoring_reads_back_equal(file: Path) -> None:
    assert load_scoring(file) == FITTED


def test_a_feature_under_its_former_name_is_read(file: Path) -> None:
    content = yaml.safe_load(file.read_text())
    content["full"]["head"]["features"] = ["away_m", "generator"]
    file.write_text(yaml.safe_dump(content))
    head = load_scoring(file).full.head
    assert head is not None
    assert head.features == ("distance_to_centre_m", "generator")


def test_the_head_is_the_logistic_regression_of_its_numbers() -> None:
    probability = HEAD.probability(measured(2, down=[0.1, 0.3], generator=[0.5, 0.75]))
    assert probability == pytest.approx([1 / (1 + np.exp(-0.5)), 1 / (1 + np.exp(-1.5))])


def test_a_head_without_bounds_stays_a_probability() -> None:
    steep = replace(HEAD, coefficients=(1e6, 1e6))
    probability = steep.probability(measured(2, down=[-1.0, 1.0]))
    assert ((probability > 0.0) & (probability < 1.0)).all()


def test_thresholds_separate_grasps_and_a_missing_alignment_passes() -> None:
    ranking = Ranking(min_alignment=0.3, min_score=0.5)
    assert ranking.passes_thresholds(np.array([0.2, 0.4, np.nan]), np.array([0.9, 0.5, 0.6])).tolist() == [
        False,
        True,
        True,
    ]
    assert Ranking().passes_thresholds(np.array([-1.0, np.nan]), np.zeros(2)).all()


def test_the_runtime_ranks_by_its_configuration_or_by_the_file_it_names(file: Path) -> None:
    assert ranking_of(RuntimeConfig(k_faces=4, alpha=0.1)) == Ranking(k_faces=4, alpha=0.1, box_method="upright")
    assert ranking_of(RuntimeConfig(k_faces=4, scoring=file)) == FITTED.full


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"version": 2}, "scoring_version"),
        ({"format": "poem"}, "scoring_format"),
        ({"mvb": None}, "scoring_value"),
        ({"tunde": []}, "scoring_value"),
        ({"tuned": ["best"]}, "scoring_value"),
        ({"full": {"k": 3}}, "scoring_value"),
        ({"full": {"k_faces": 9}}, "scoring_value"),
        ({"full": {"k_faces": True}}, "scoring_value"),
        ({"full": {"alpha": "much"}}, "scoring_value"),
        ({"full": {"hard_filter": 1}}, "scoring_value"),
        ({"full": {"alpha": float("nan")}}, "scoring_value"),
        ({"full": {"box_method": "sphere"}}, "scoring_value"),
        ({"full": {"min_score": 2}}, "scoring_value"),
        ({"full": {"min_alignment": -3}}, "scoring_value"),
    ],
)
def test_a_wrong_scoring_is_rejected_with_its_name(file: Path, change: dict, code: str) -> None:
    content = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump(content | change))
    with raises(ScoringError, code) as caught:
        load_scoring(file)
    assert "scoring.yaml" in str(caught.value)


@pytest.mark.integration
@pytest.mark.parametrize(
    "change",
    [
        {"features": ["colour", "down"]},
        {"features": []},
        {"mean": [0.1]},
        {"mean": ["a", "b"]},
        {"scale": None},
        {"coefficients": [1.0, float("inf")]},
        {"scale": [0.0, 1.0]},
        {"intercept": float("nan")},
        {"pickle": "…"},
    ],
)
def test_a_wrong_head_is_rejected(file: Path, change: dict) -> None:
    content = yaml.safe_load(file.read_text())
    content["full"]["head"] |= change
    file.write_text(yaml.safe_dump(content))
    with raises(ScoringError, "scoring_value"):
        load_scoring(file)


@pytest.mark.parametrize(
    ("text", "code"), [("a: [", "scoring_unreadable"), ("", "scoring_format"), ("- 1", "scoring_format")]
)
def test_another_file_is_rejected(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with raises(ScoringError, code):
        load_scoring(tmp_path / "x.yaml")


def test_a_missing_file_and_a_missing_part_are_rejected_with_the_remedy(tmp_path: Path, file: Path) -> None:
    with raises(ScoringError, "scoring_unreadable") as caught:
        load_scoring(tmp_path / "nowhere.yaml")
    assert "nowhere.yaml" in str(caught.value)
    assert "./z1 tune" in str(caught.value)
    content = yaml.safe_load(file.read_text())
    del content["full"]["head"]["intercept"]
    file.write_text(yaml.safe_dump(content))
    with raises(ScoringError, "scoring_incomplete") as caught:
        load_scoring(file)
    assert "full.head" in str(caught.value)
    del content["full"]
    file.write_text(yaml.safe_dump(content))
    with raises(ScoringError, "scoring_incomplete"):
        load_scoring(file)

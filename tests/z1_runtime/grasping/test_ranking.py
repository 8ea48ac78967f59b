"""A scoring file says what it holds, and is refused with the reason when it cannot be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from z1_runtime.config import RuntimeConfig, ranking_of
from z1_runtime.grasping.features import FEATURES
from z1_runtime.grasping.ranking import Ranking, Scoring, ScoringError, ScoringHead, load_scoring, save_scoring

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


def test_the_head_is_the_logistic_regression_that_its_numbers_say() -> None:
    likely = HEAD.probability(measured(2, down=[0.1, 0.3], generator=[0.5, 0.75]))
    assert likely == pytest.approx([1 / (1 + np.exp(-0.5)), 1 / (1 + np.exp(-1.5))])


def test_a_head_without_bounds_stays_a_probability() -> None:
    steep = replace(HEAD, coefficients=(1e6, 1e6))
    likely = steep.probability(measured(2, down=[-1.0, 1.0]))
    assert ((likely > 0.0) & (likely < 1.0)).all()


def test_thresholds_part_the_grasps_and_an_alignment_that_no_box_told_passes() -> None:
    ranking = Ranking(min_alignment=0.3, min_score=0.5)
    assert ranking.wanted(np.array([0.2, 0.4, np.nan]), np.array([0.9, 0.5, 0.6])).tolist() == [False, True, True]
    assert Ranking().wanted(np.array([-1.0, np.nan]), np.zeros(2)).all()


def test_the_runtime_ranks_by_its_configuration_or_by_the_file_it_names(file: Path) -> None:
    assert ranking_of(RuntimeConfig(k_faces=4, alpha=0.1)) == Ranking(k_faces=4, alpha=0.1, box_method="upright")
    assert ranking_of(RuntimeConfig(k_faces=4, scoring=str(file))) == FITTED.full


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 2}, "version 2; this program reads 1"),
        ({"format": "poem"}, "no scoring file"),
        ({"mvb": None}, "holds None"),
        ({"tuned": ["best"]}, "allowed: mvb, full"),
        ({"full": {"k": 3}}, "unknown key 'k'"),
        ({"full": {"k_faces": 9}}, "allowed is 1 to 6"),
        ({"full": {"k_faces": True}}, "type int"),
        ({"full": {"alpha": "much"}}, "alpha is 'much'; it must be of type float"),
        ({"full": {"hard_filter": 1}}, "type bool"),
        ({"full": {"alpha": float("nan")}}, "alpha is nan"),
        ({"full": {"box_method": "sphere"}}, "pca, min_volume, upright"),
        ({"full": {"min_score": 2}}, "min_score is 2"),
        ({"full": {"min_alignment": -3}}, "min_alignment is -3"),
    ],
)
def test_a_wrong_scoring_is_refused_with_its_name_and_the_reason(file: Path, change: dict, said: str) -> None:
    content = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump(content | change))
    with pytest.raises(ScoringError, match=said) as caught:
        load_scoring(file)
    assert "scoring.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"features": ["colour", "down"]}, "the head goes by colour, down; known: generator"),
        ({"features": []}, "no feature"),
        ({"mean": [0.1]}, "2 finite numbers"),
        ({"mean": ["a", "b"]}, "could not convert"),
        ({"scale": None}, "cannot be used"),
        ({"coefficients": [1.0, float("inf")]}, "2 finite numbers"),
        ({"scale": [0.0, 1.0]}, "scale > 0"),
        ({"pickle": "…"}, "unknown key 'pickle'"),
    ],
)
def test_a_wrong_head_is_refused(file: Path, change: dict, said: str) -> None:
    content = yaml.safe_load(file.read_text())
    content["full"]["head"] |= change
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(ScoringError, match=said):
        load_scoring(file)


@pytest.mark.parametrize(("text", "said"), [("a: [", "not YAML"), ("", "no scoring file"), ("- 1", "no scoring file")])
def test_what_is_no_scoring_at_all_is_told(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ScoringError, match=said):
        load_scoring(tmp_path / "x.yaml")


def test_a_missing_file_and_a_missing_part_are_told(tmp_path: Path, file: Path) -> None:
    with pytest.raises(ScoringError, match=r"nowhere\.yaml cannot be read.*z1 tune"):
        load_scoring(tmp_path / "nowhere.yaml")
    content = yaml.safe_load(file.read_text())
    del content["full"]
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(ScoringError, match="lacks 'full'"):
        load_scoring(file)

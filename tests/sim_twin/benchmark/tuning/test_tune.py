"""What was set by hand stays unless what was fitted wins where it was not fitted."""

from pathlib import Path

import pytest

from sim_twin.benchmark.episodes.methods import parse_method
from sim_twin.benchmark.tuning.fit import tune
from sim_twin.benchmark.tuning.logged_episodes import TuneError, load_logs
from sim_twin.benchmark.tuning.report import write_tuning_report
from tests.support.errors import raises
from tests.support.tune_episodes import episode, number_of, scenarios, write_run
from z1_runtime.grasping.ranking import FEATURES, load_scoring, save_scoring

pytest.importorskip("sklearn", reason="uv sync --inexact --extra tune")


def rows_of(seed, method, works, **more):
    """Return a row for each scenario; `works` says of its number whether it succeeds."""
    return [episode(s, method, works(n), candidate=number_of(method), **more) for n, s in enumerate(scenarios(seed))]


def often(n):
    return n % 10 != 0


def half(n):
    return n % 2 == 0


class Runs:
    """Fake twin: an episode succeeds as `works` says of the method."""

    def __init__(self, works):
        self.works, self.asked = works, []

    def __call__(self, methods, wanted, done):
        self.asked += [method.name for method in methods]
        numbers = {scenario.key: n for seed in range(4) for n, scenario in enumerate(scenarios(seed))}
        return [
            episode(scenario, method.name, self.works(method, numbers[scenario.key]))
            for scenario in wanted
            for method in methods
            if (scenario.key, method.name) not in done
        ]


@pytest.fixture
def fitted(tmp_path):
    """Returns what tuning on seed 1, where k = 3 is far better, comes to on seed 2."""

    def run(rows, *, runs=None, head=False, reading="top1", held_out=(2,)):
        logs = load_logs([write_run(tmp_path / "log", rows)])
        return tune(logs, held_out_seeds=held_out, reading=reading, folder=tmp_path / "p", run=runs, head=head)

    return run


TRAIN = [*rows_of(1, "mvb", half), *rows_of(1, "mvb:k=3", often)]


def test_a_variant_that_wins_on_held_out_seeds_is_taken(fitted):
    family = fitted([*TRAIN, *rows_of(2, "mvb", half), *rows_of(2, "mvb:k=3", often)]).families["mvb"]
    assert family.tuned
    assert family.kept == parse_method("mvb:k=3").ranking(family.draft.baseline)
    assert family.kept.k_faces == 3
    (proposal,) = family.proposals
    tally = proposal.results["top1"]
    assert (tally.baseline, tally.tuned, tally.scenarios) == (41, 72, 81)
    assert "took k=3" in family.why
    assert "72 of 81 against 41" in family.why


def test_one_that_was_better_only_where_it_was_chosen_is_not(fitted):
    tuning = fitted([*TRAIN, *rows_of(2, "mvb", often), *rows_of(2, "mvb:k=3", half)])
    family = tuning.families["mvb"]
    assert not family.tuned
    assert family.kept == family.draft.baseline
    assert "kept the hand-set values" in family.why
    assert "41 of 81 (top1) against 72" in family.why
    assert tuning.scoring.tuned == ()
    assert tuning.scoring.mvb == family.draft.baseline


def test_a_few_more_successes_are_not_enough(fitted):
    barely = rows_of(2, "mvb:k=3", lambda n: half(n) or n in (1, 3))
    family = fitted([*TRAIN, *rows_of(2, "mvb", half), *barely]).families["mvb"]
    assert not family.tuned
    assert "43 of 81 (top1) against 41, McNemar p = 0.5 where below 0.05 was required" in family.why


def test_what_wins_in_one_reading_and_loses_in_the_other_is_not_taken(fitted):
    baseline = rows_of(2, "mvb", lambda n: True, rank=1)
    family = fitted([*TRAIN, *baseline, *rows_of(2, "mvb:k=3", often)]).families["mvb"]
    assert family.proposals[0].results["top1"].tuned == 72
    assert not family.tuned
    assert "but 72 against 81 (fallthrough)" in family.why


@pytest.mark.parametrize(("lost", "tuned"), [(1, True), (2, False)])
def test_one_of_81_lost_in_the_other_reading_says_nothing(fitted, lost: int, tuned: bool):
    baseline = rows_of(2, "mvb", lambda n: True, rank=1)
    family = fitted([*TRAIN, *baseline, *rows_of(2, "mvb:k=3", lambda n: n >= lost)]).families["mvb"]
    assert family.proposals[0].results["fallthrough"].tuned == 81 - lost
    assert family.tuned is tuned


def test_where_the_hand_set_values_are_best_nothing_is_proposed_nor_run(fitted):
    runs = Runs(lambda *_: True)
    family = fitted([*rows_of(1, "mvb", often), *rows_of(1, "mvb:k=3", half)], runs=runs).families["mvb"]
    assert family.proposals == ()
    assert runs.asked == []
    assert "nothing was proposed" in family.why


def test_what_is_missing_on_the_held_out_seeds_is_run_with_the_proposals_own_numbers(fitted):
    runs = Runs(lambda method, n: often(n) if method.k == 3 else half(n))
    family = fitted(TRAIN, runs=runs).families["mvb"]
    assert runs.asked == ["mvb", "mvb:k=3"]
    assert family.tuned


def test_without_episodes_on_held_out_seeds_the_hand_set_values_stay(fitted):
    family = fitted(TRAIN).families["mvb"]
    assert not family.tuned
    assert "no proposal was run" in family.why


@pytest.mark.integration
def test_a_head_is_proposed_as_a_file_and_taken_when_its_episodes_win(fitted, tmp_path):
    rows = [*rows_of(1, "mvb", half), *rows_of(1, "full", often)]
    runs = Runs(lambda method, n: often(n) if method.head else half(n))
    tuning = fitted(rows, runs=runs, head=True)
    assert tuning.head is not None
    assert tuning.head.beats_base_rate
    mvb, full = tuning.families["mvb"], tuning.families["full"]
    assert mvb.tuned
    assert mvb.kept.head == tuning.head.head == full.kept.head
    assert tuning.scoring.tuned == ("mvb", "full")
    assert len(runs.asked) == 4
    assert all(":scoring=" in name for name in (mvb.proposals[-1].method, full.proposals[-1].method))
    filed = load_scoring(Path(full.proposals[-1].method.partition("scoring=")[2]))
    assert (filed.mvb, filed.full) == (mvb.draft.baseline, full.kept)

    save_scoring(tuning.scoring, tmp_path / "scoring.yaml")
    assert load_scoring(tmp_path / "scoring.yaml") == tuning.scoring
    assert parse_method(f"mvb:scoring={tmp_path / 'scoring.yaml'}").head == tuning.head.head
    write_tuning_report(tuning, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "took k=2 α=0.85 box=pca + head" in page
    assert page.count("<svg") == 3
    assert FEATURES["down"] in page


@pytest.mark.integration
def test_the_limit_is_shared_among_the_proposals(fitted):
    runs = Runs(lambda method, n: half(n) or n in (1, 3, 5, 7, 9, 11) if method.head or method.k == 3 else half(n))
    both = fitted(TRAIN, runs=runs, head=True).families["mvb"]
    assert len(both.proposals) == 2
    assert 0.025 < both.proposals[0].results["top1"].test.p < 0.05
    assert not both.tuned
    assert "below 0.025 was required" in both.why


def test_rows_that_cannot_be_tuned_on_are_rejected(fitted, tmp_path):
    with raises(TuneError, "all_held_out"):
        fitted(TRAIN, held_out=(1,))
    (tmp_path / "log").rename(tmp_path / "old")
    with raises(TuneError, "no_baseline"):
        fitted(rows_of(1, "vanilla", half))


def test_a_mesh_of_the_users_own_cannot_be_run_again(fitted):
    rows = [row | {"object": "tin-1", "scenario": f"tin-1-{n}-s1"} for n, row in enumerate(TRAIN[:81])]
    rows += [row | {"object": "tin-1", "scenario": f"tin-1-{n}-s1"} for n, row in enumerate(TRAIN[81:])]
    with raises(TuneError, "mesh_episodes"):
        fitted(rows, runs=Runs(lambda *_: True))

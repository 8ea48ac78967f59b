import json

import pytest

from sim_twin.benchmark.results.summary import summarise, write_summary


def row(scenario, method, success, rank=0, **more):
    return {
        "scenario": scenario, "method": method, "success": success, "success_top1": success and rank == 0,
        "mode": "success" if success else "missed", "object": "box", "distance": "near", "lateral": "left",
        "pitch_deg": 0.0, "occlusion": 0.0, "rank": rank, "n_candidates": 800, **more,
    }  # fmt: skip


ROWS = [
    row("a", "vanilla", True, rank=3), row("b", "vanilla", False), row("c", "vanilla", False),
    row("a", "mvb", True), row("b", "mvb", True), row("c", "mvb", False),
]  # fmt: skip


def test_one_run_gives_both_readings():
    methods = summarise(ROWS)["methods"]
    assert methods["vanilla"]["rate"] == pytest.approx(1 / 3)
    assert methods["vanilla"]["rate_top1"] == 0.0
    assert methods["mvb"]["rate_top1"] == pytest.approx(2 / 3)
    assert methods["mvb"]["modes"] == {"success": 2, "missed": 1}


def test_methods_are_compared_on_the_same_scenarios():
    pairs = {pair["reading"]: pair for pair in summarise([*ROWS, row("d", "mvb", True)])["paired"]}
    assert pairs["fallthrough"]["scenarios"] == 3
    assert (pairs["top1"]["only_first"], pairs["top1"]["only_second"]) == (0, 2)


def test_success_is_broken_down_by_condition():
    by = summarise([*ROWS, row("e", "mvb", True, distance="far")])["methods"]["mvb"]["by"]["distance"]
    assert by["far"]["episodes"] == 1
    assert by["near"]["rate"] == pytest.approx(2 / 3)


def test_the_summary_is_a_file_that_json_reads(tmp_path):
    write_summary(ROWS, tmp_path / "summary.json", {"version": "1"})
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["methods"]["mvb"]["episodes"] == 3
    assert content["run"] == {"version": "1"}

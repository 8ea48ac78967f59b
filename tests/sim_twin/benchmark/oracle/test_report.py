import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from sim_twin.benchmark.episodes.scenarios import grid
from sim_twin.benchmark.oracle.report import summarise, write_report, write_summary


def make_rows():
    """Return rows of the 81, of which those of the leaning bottle fail."""
    rows = []
    for scenario in grid():
        fails = scenario.object == "bottle" and scenario.pitch_deg == -45.0
        modes = ["missed"] * 3 + ["dropped"] if fails else ["missed"] * (scenario.distance == "far") + ["success"]
        row = {**scenario.columns(), "method": "oracle", "success": not fails, "modes": modes}
        row |= {"verdict": "unsolved" if fails else "solved", "executions": len(modes), "exhausted": fails}
        rows.append(row | {"n_reachable": 0 if fails else 120})
    return rows


def test_the_summary_counts_what_is_solved_and_how_soon():
    summary = summarise(make_rows())
    assert (summary["solved"], summary["episodes"]) == (72, 81)
    assert summary["by"]["object"]["bottle"]["solved"] == 18
    assert summary["by"]["pitch_deg"]["-45.0"]["solved"] == 18
    assert summary["solved_within"][1] == 48
    assert summary["solved_within"][2] == 72
    assert len(summary["unsolved"]) == 9
    assert summary["unsolved"][0]["modes"] == {"missed": 3, "dropped": 1}
    assert summary["reachable"] == {"least": 0, "median": 120.0}


def test_methods_are_measured_by_what_can_be_solved_whatever_their_seed():
    bench = [
        {**scenario.columns(), "method": "full", "success": scenario.object != "box"} for scenario in grid(seeds=(3,))
    ]
    bench.append({**bench[0], "method": "full", "object": "mug"})  # the oracle was not asked about it
    full = summarise(make_rows(), bench)["methods"]["full"]
    assert full["episodes"] == 81
    assert full["solvable"] == 72
    assert full["solved"] == 45
    assert full["solved_where_the_oracle_did_not"] == 9
    assert np.isclose(full["rate_of_solvable"], 45 / 72)


def test_neighbours_of_another_seed_are_another_scene():
    rows = [{**row, "clutter": 2} for row in make_rows()]
    bench = [{**row, "method": "full", "seed": 1} for row in rows]
    assert summarise(rows, bench)["methods"] == {}


@pytest.mark.integration
def test_the_page_shows_a_grid_for_each_object_and_pitch_and_what_failed(tmp_path):
    rows = make_rows()
    summary = write_summary(rows, tmp_path / "summary.json", {"version": "1"}, rows)
    write_report(rows, summary, tmp_path / "report.html")
    assert json.loads((tmp_path / "summary.json").read_text())["solved"] == 72
    page = (tmp_path / "report.html").read_text()
    grids = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(grids) == 9
    texts = [element.text for element in ElementTree.fromstring(grids[1]).iter() if element.text]
    assert texts.count("120") == 9
    assert texts.count("2 executed") == 3
    assert "bottle-far-centre--45-s0" in page
    assert "72 of 81" in page
    assert "missed 3, dropped 1" in page

import io

import numpy as np
import pytest
from PIL import Image

from sim_twin.benchmark.episodes.scenarios import Scenario, grid
from sim_twin.benchmark.report import pictures
from sim_twin.benchmark.report.pictures import choose_failures, draw_pictures
from sim_twin.model.world import World


def row(method, mode, qpos=(0.0,), **more):
    return {"scenario": "a", "method": method, "mode": mode, "success": mode == "success", "final_qpos": qpos, **more}


def test_failure_modes_take_turns_and_what_never_moved_is_left_out():
    rows = [row("mvb", "missed", n=n) for n in range(5)]
    rows += [row("mvb", "success"), row("mvb", "no IK", qpos=None), row("full", "missed"), row("mvb", "slipped")]
    chosen = choose_failures(rows, maximum=4)
    assert [(r["method"], r["mode"]) for r in chosen] == [
        ("mvb", "missed"), ("full", "missed"), ("mvb", "slipped"), ("mvb", "missed")
    ]  # fmt: skip


def test_a_row_says_which_scenario_it_is():
    for scenario in grid(occlusions=(0.25,)):
        assert Scenario.from_row(scenario.columns() | {"method": "mvb"}) == scenario


@pytest.mark.integration
def test_the_final_state_is_drawn_from_the_row(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("Z1_TWIN_RENDER", "rays")
    monkeypatch.setattr(pictures, "_SIZE", (240, 135))
    scenario = Scenario(object="mug", distance="mid", lateral="centre", pitch_deg=0.0)
    qpos = World(scenario.scene()).data.qpos.tolist()
    rows = [scenario.columns() | row("mvb:k=3", "missed", qpos) | {"scenario": scenario.key}]
    shown = draw_pictures(rows, "failures", tmp_path / "pictures")
    (file,) = (tmp_path / "pictures").iterdir()
    assert file.name == "mug-mid-centre-+0-s0-mvb_k_3.png"
    ((of, picture),) = shown
    assert of is rows[0]
    assert picture.caption == "mug-mid-centre-+0-s0, mvb:k=3: missed"
    large, small = Image.open(file).convert("RGB"), Image.open(io.BytesIO(picture.jpeg))
    again = np.asarray(small.resize(large.size), dtype=float)
    assert np.abs(again - np.asarray(large)).mean() < 8.0


def test_no_pictures_are_drawn_unless_asked_for(tmp_path):
    assert draw_pictures([row("mvb", "missed")], "none", tmp_path / "pictures") == []
    assert not (tmp_path / "pictures").exists()


def test_an_object_whose_mesh_is_not_given_again_is_left_out(tmp_path):
    gone = {**row("mvb", "missed"), "object": "drill-12345678"}
    assert draw_pictures([gone], "failures", tmp_path / "pictures") == []

"""Configuration: defaults, file over defaults, and errors that name the key."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hal.base.errors import ConfigError
from z1_runtime.config import RuntimeConfig, load_config, save_config, with_generator


def test_without_a_file_the_defaults_are_in_force() -> None:
    assert load_config() == RuntimeConfig()


def test_a_saved_configuration_reads_back_equal(tmp_path: Path) -> None:
    config = replace(RuntimeConfig(), n_candidates=77, speed=0.3, box_method="pca")
    save_config(config, tmp_path / "c.yaml")
    assert load_config(tmp_path / "c.yaml") == config


def test_a_file_changes_only_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("speed: 1\nplanner:\n  lift_m: 0.2\nperception:\n  clip_percent: [2, 98]\n")
    config = load_config(path)
    assert (config.speed, config.planner.lift_m, config.perception.clip_percent) == (1.0, 0.2, (2.0, 98.0))
    changed = asdict(config)
    default = asdict(RuntimeConfig())
    for tree in (changed, default):
        del tree["speed"], tree["planner"]["lift_m"], tree["perception"]["clip_percent"]
    assert changed == default


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sped: 0.5", "did you mean 'speed'"),
        ("speed: fast", "speed is 'fast'"),
        ("speed: 7", "above 0, up to 1"),
        ("planner:\n  lift: 0.2", "'lift'"),
        ("planner: 3", "keys and values"),
        ("n_candidates: true", "n_candidates is True"),
        ("perception:\n  clip_percent: [1]", "clip_percent"),
        ("box_method: sphere", "box_method"),
        ("hold_s: -1", "hold_s is -1.0; allowed is 0 to 60 s"),
        ("frame_timeout_s: .nan", "frame_timeout_s is nan"),
        ("held_torque_nm: -2", "held_torque_nm is -2.0"),
        ("executor:\n  stall_timeout_s: 0", "stall_timeout_s is 0.0"),
        ("planner:\n  collision:\n    transfer_threshold_m: 0.05", "transfer_threshold_m is 0.05"),
        ("perception:\n  own:\n    margin_m: 1", "margin_m is 1.0"),
        ("- 1", "keys and values"),
        ("a: [", "not YAML"),
    ],
)
def test_a_wrong_file_is_refused_with_the_key(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"c\.yaml") as caught:
        load_config(path)
    assert said in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load_config(tmp_path / "nowhere.yaml")


def test_a_command_line_s_weights_choose_their_generator_unless_one_that_takes_them_is_configured(tmp_path):
    weights = tmp_path / "graspgen_franka_panda.yml"
    plain, union = RuntimeConfig(), RuntimeConfig(generator="union:obb_sweep+graspgen")
    assert with_generator(plain, None, None) == plain
    assert with_generator(plain, "obb_sweep", None).generator == "obb_sweep"
    chosen = with_generator(plain, None, weights)
    assert (chosen.generator, chosen.generator_weights) == ("graspgen", str(weights))
    assert with_generator(union, None, weights).generator == union.generator
    assert with_generator(plain, union.generator, weights).generator == union.generator

"""Configuration: defaults, file over defaults, and errors that name the key."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hal.base.errors import ConfigError
from tests.support.errors import raises
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
    ("text", "code", "key"),
    [
        ("sped: 0.5", "unknown_key", "sped"),
        ("speed: fast", "wrong_type", "speed"),
        ("speed: 7", "out_of_range", ""),
        ("planner:\n  lift: 0.2", "unknown_key", "planner.lift"),
        ("planner: 3", "wrong_type", "planner"),
        ("n_candidates: true", "wrong_type", "n_candidates"),
        ("k_faces: 2.0", "wrong_type", "k_faces"),
        ("perception:\n  clip_percent: [1]", "wrong_type", "perception.clip_percent.1"),
        ("box_method: sphere", "wrong_type", "box_method"),
        ("hold_s: -1", "out_of_range", ""),
        ("frame_timeout_s: .nan", "out_of_range", ""),
        ("held_torque_nm: -2", "out_of_range", ""),
        ("executor:\n  stall_timeout_s: 0", "out_of_range", "executor"),
        ("planner:\n  collision:\n    transfer_threshold_m: 0.05", "out_of_range", "planner.collision"),
        ("perception:\n  self_filter:\n    margin_m: 1", "out_of_range", "perception.self_filter"),
        ("- 1", "wrong_type", ""),
        ("a: [", "not_yaml", ""),
    ],
)
def test_an_invalid_file_is_rejected_with_its_name_and_key(tmp_path: Path, text: str, code: str, key: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with raises(ConfigError, code) as caught:
        load_config(path)
    assert caught.value.key == key
    assert str(path) in str(caught.value)


def test_a_typing_error_gets_a_suggestion_and_a_wrong_value_its_range(tmp_path: Path) -> None:
    for text, hint in (("sped: 0.5", "did you mean 'speed'?"), ("hold_s: -1", "hold_s is -1.0; allowed is 0 to 60 s")):
        (tmp_path / "c.yaml").write_text(text)
        with pytest.raises(ConfigError) as caught:
            load_config(tmp_path / "c.yaml")
        assert hint in str(caught.value)


@pytest.mark.parametrize("content", [b"generator: gew\xfcrz", None])
def test_an_unreadable_file_is_rejected(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "c.yaml"
    if content is not None:
        path.write_bytes(content)
    with raises(ConfigError, "unreadable") as caught:
        load_config(path)
    assert str(path) in str(caught.value)


def test_a_command_line_s_weights_choose_their_generator_unless_one_that_takes_them_is_configured(tmp_path):
    weights = tmp_path / "graspgen_franka_panda.yml"
    plain, union = RuntimeConfig(), RuntimeConfig(generator="union:obb_sweep+graspgen")
    assert with_generator(plain, None, None) == plain
    assert with_generator(plain, "obb_sweep", None).generator == "obb_sweep"
    chosen = with_generator(plain, None, weights)
    assert (chosen.generator, chosen.generator_options.weights) == ("graspgen", weights)
    assert with_generator(union, None, weights).generator == union.generator
    assert with_generator(plain, union.generator, weights).generator == union.generator

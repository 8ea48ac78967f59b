"""The output of `show-config` is a valid input of `--config`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import yaml

from hal.base.errors import ConfigError
from scripts.commands.show_config import ShowConfig, main, to_lines
from z1_runtime.config import RuntimeConfig, load_config


def test_output_read_back_is_the_same_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(ShowConfig())
    path = tmp_path / "shown.yaml"
    path.write_text(capsys.readouterr().out)
    assert load_config(path) == RuntimeConfig()


def test_each_value_has_its_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("alpha: 0.5\n")
    main(ShowConfig(config=path))
    lines = capsys.readouterr().out.splitlines()
    assert f"alpha: 0.5  # {path}" in lines
    assert f"k_faces: {RuntimeConfig().k_faces}  # default" in lines


def test_nested_values_and_tuples_are_yaml() -> None:
    values = {"a": {"b": (1.0, 2.0), "c": None}, "d": "yes", "e": Path("x")}
    text = "\n".join(to_lines(values, {"a": {"b": [1, 2]}}, "file"))
    assert yaml.safe_load(text) == {"a": {"b": [1.0, 2.0], "c": None}, "d": "yes", "e": "x"}
    assert "  b: [1.0, 2.0]  # file" in text
    assert "  c: null  # default" in text


def test_all_settings_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    main(ShowConfig())
    assert set(yaml.safe_load(capsys.readouterr().out)) == set(asdict(RuntimeConfig()))


def test_missing_file_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        main(ShowConfig(config=tmp_path / "nowhere.yaml"))
    assert "nowhere.yaml" in str(caught.value)

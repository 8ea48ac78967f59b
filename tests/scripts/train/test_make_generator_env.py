"""The environments of NVIDIA's generators, made by a fake installer."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from scripts.train.make_generator_env import PACKAGES, InstallError, make_environment
from tests.support.errors import raises


def fake_uv(tmp_path: Path, fails_at: str = "never") -> Path:
    """Return an executable that logs its arguments, makes the folder, and fails at one command."""
    uv = tmp_path / "uv"
    uv.write_text(
        f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n'
        f'[ "$1" = {fails_at} ] && exit 1\n'
        'for last; do :; done\n[ "$1" = venv ] && mkdir -p "$last/bin" && touch "$last/bin/python"\nexit 0\n'
    )
    uv.chmod(0o755)
    return uv


@pytest.mark.parametrize("name", PACKAGES)
def test_the_tested_package_goes_into_a_folder_of_its_own(name: str, tmp_path: Path):
    python = make_environment(name, fake_uv(tmp_path), "cpu", tmp_path / "generators")
    assert python == tmp_path / "generators" / name / "bin" / "python" and python.is_file()
    made, installed = (tmp_path / "calls").read_text().splitlines()
    assert made == f"venv --clear --python {sys.executable} {tmp_path}/generators/{name}"
    assert installed == f"pip install --python {python} --torch-backend=cpu {PACKAGES[name]} torch>=2.6"


@pytest.mark.parametrize("step", ["venv", "pip"])
def test_an_installer_that_fails_leaves_nothing_behind(step: str, tmp_path: Path):
    with raises(InstallError, "uv_failed") as caught:
        make_environment("graspgenx", fake_uv(tmp_path, step), "", tmp_path / "generators")
    assert f"uv {step}" in str(caught.value)
    assert not (tmp_path / "generators" / "graspgenx").exists()

"""Folders of results: one run at a time, no links, and one line for a folder that cannot be used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hal.base.files import atomic_write
from hal.base.output_folder import OutputError, check_output_file, create_file, open_output
from tests.support.errors import raises

_HOLD = """
import sys
from pathlib import Path
from hal.base.output_folder import open_output
with open_output(Path(sys.argv[1])):
    print("open", flush=True)
    sys.stdin.read()
"""


def test_a_second_run_is_locked_out_until_the_first_ends(tmp_path: Path) -> None:
    with open_output(tmp_path / "out"), raises(OutputError, "output_locked"), open_output(tmp_path / "out"):
        pass
    with open_output(tmp_path / "out") as folder:
        assert list(folder.iterdir()) == []


def test_a_killed_run_leaves_no_lock(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "open\n"
        with raises(OutputError, "output_locked"), open_output(tmp_path):
            pass
        other.kill()
    with open_output(tmp_path):
        pass


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "there")
    with raises(OutputError, "output_link"), open_output(link):
        pass
    link.unlink()
    link.symlink_to(tmp_path / "nowhere")
    with raises(OutputError, "output_link"), open_output(link):
        pass


@pytest.mark.parametrize("name", ["file", "file/below", "x" * 300, "a\0b"])
def test_a_name_that_cannot_be_a_folder_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("mine")
    with raises(OutputError, "output_unusable") as caught, open_output(tmp_path / name):
        pass
    assert "\n" not in str(caught.value)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("name", [".", "file/below", "x" * 300 + "/a", "a\0b/c"])
def test_a_name_that_cannot_be_a_file_is_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("mine")
    with raises(OutputError, "output_unusable"):
        check_output_file(tmp_path / name)


@pytest.mark.parametrize("write", [lambda path: atomic_write(path, b"new"), lambda path: create_file(path).close()])
def test_a_file_that_is_a_link_is_replaced_and_its_target_stays(tmp_path: Path, write) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("mine")
    link.symlink_to(target)
    write(link)
    assert target.read_text() == "mine"
    assert not link.is_symlink()


def test_a_link_under_the_name_of_the_partial_file_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.write_text("mine")
    (tmp_path / f".a.json.{os.getpid()}.partial").symlink_to(target)
    atomic_write(tmp_path / "a.json", b"new")
    assert target.read_text() == "mine"
    assert (tmp_path / "a.json").read_text() == "new"

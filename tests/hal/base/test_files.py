"""Atomic writing: the complete content or the old one, and no partial file."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.base.files import PARTIAL, atomic_path, atomic_write


@pytest.mark.parametrize(("data", "stored"), [("größer\n", "größer\n".encode()), (b"\x00\xff", b"\x00\xff")])
def test_the_new_content_replaces_the_old_one(tmp_path: Path, data: bytes | str, stored: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    atomic_write(path, data)
    assert path.read_bytes() == stored
    assert list(tmp_path.iterdir()) == [path]


def test_the_old_content_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_text("old")
    with atomic_path(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
        assert partial.name.endswith(PARTIAL)
        assert list(tmp_path.glob("*.npz")) == [path]
    assert path.read_text() == "new"


def test_an_interrupted_write_leaves_the_old_file_and_no_partial_one(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as partial:
        partial.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_text_that_is_not_utf8_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(UnicodeEncodeError):
        atomic_write(tmp_path / "a.txt", "\ud800")
    assert not list(tmp_path.iterdir())

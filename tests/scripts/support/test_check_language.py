"""The vocabulary check finds a planted word, and only whole words."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.support import check_language
from scripts.support.check_language import BANNED, Finding, check_files, check_text, replacement

WORDS = [word for pattern in BANNED if pattern.replace("|", "").isalpha() for word in pattern.split("|")]
PLANTED = WORDS[0]


@pytest.mark.parametrize("word", WORDS)
def test_every_plain_word_of_the_list_is_found_and_has_a_replacement(word: str) -> None:
    assert [finding.word for finding in check_text("x.py", f"a {word}.")] == [word]
    assert replacement(word)


@pytest.mark.parametrize("text", ["{}", "# {}!", "so_{}_m = 1", "first\n{}"])
def test_word_is_found_in_prose_and_in_identifiers(text: str) -> None:
    found = list(check_text("x.py", text.format(PLANTED.upper())))
    assert [finding.line for finding in found] == [len(text.splitlines())]


@pytest.mark.parametrize(
    "text", ["reachability", "address", "gripperMover", "layout", "least", "release", "believable"]
)
def test_part_of_another_word_is_not_found(text: str) -> None:
    assert list(check_text("x.py", text)) == []


def test_planted_word_is_reported_with_path_and_line(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(f"fine\nas {PLANTED} before\n")
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\xff" + PLANTED.encode())
    (tmp_path / "LICENSE").write_text(PLANTED)
    paths = ["page.md", "picture.png", "LICENSE"]
    assert list(check_files(paths, tmp_path)) == [Finding("page.md", 2, PLANTED)]


def test_exit_code_depends_on_findings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "page.md").write_text("fine\n")
    monkeypatch.setattr(check_language, "tracked_files", lambda: ["page.md"])
    monkeypatch.setattr(check_language, "check_files", lambda paths: check_files(paths, tmp_path))
    assert check_language.main([]) == 0
    (tmp_path / "page.md").write_text(f"{PLANTED}\n")
    assert check_language.main([]) == 1
    assert f"page.md:1: {PLANTED!r}" in capsys.readouterr().out

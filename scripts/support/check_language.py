"""Vocabulary check of `./z1 check`: reports words that the glossary bans from code, documentation and tests."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

BANNED: dict[str, str] = {
    "told|tells": "report, say, state",
    "whoever|somebody|nobody": "the operator, a client, no process",
    "lest": "so that … not",
    "anew": "again",
    r"reckon[a-z]*": "compute, estimate",
    "dear|dearer": "costly",
    r"haste|hasten[a-z]*|hurry": "speed scale",
    r"wish[a-z]*": "setpoint, command",
    r"ail|ails|ailments?|illness|complaints?": "fault",
    "lies": "is, is at",
    "stands": "is, is at",
    "beside": "next to, at",
    r"mend[a-z]*": "repair",
    r"ma(?:de|kes?) up for": "compensate",
    "lie around|lay": "placement, jaw fit",
    "movers?": "moving jaw",
    r"heed[a-z]*": "accept, handle",
    "askers?": "requester, client",
    "deaf": "no heartbeat",
    "(?:gives?|gave|giving)[ _]way": "yield",
    "ability|ease": "reachability, manipulability",
    "unseen|untold": "occluded, unobserved, held-out",
    "blanked|tamed?": "masked, filtered",
    r"spoil[a-z]*|dress|dresse[sd]": "augmentation",
    r"judg(?:e|es|ed|ing)": "evaluate, label",
    r"beliefs?|believe[sd]?|doubt[a-z]*": "estimate, uncertainty",
    "promptness": "latency",
}
"""Pattern of banned words to the terms that replace them (glossary, rule 7 and its unambiguous "never" terms)."""

EXCLUDED = ("LICENSE", "uv.lock", "docs/glossary.md", "scripts/support/check_language.py")
"""Paths that must hold banned words: licence texts, package names, and the lists of the words themselves."""

# Underscores separate words too, so that identifiers are checked; camelCase names of the URDF, such as its
# `gripper` + `Mover`, are not the project's to choose.
_WORD = re.compile("|".join(rf"(?<![A-Za-z])(?:{pattern})(?![A-Za-z])" for pattern in BANNED), re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Finding:
    """A banned word in a file."""

    path: str
    line: int
    word: str


def main(arguments: list[str]) -> int:
    """Check the files of this checkout; return 1 if a banned word is left."""
    counts = arguments == ["--counts"]
    findings = list(check_files(tracked_files()))
    if counts:
        for package, n in Counter(finding.path.split("/")[0] for finding in findings).most_common():
            print(f"{n:>5}  {package}")
    else:
        for finding in findings:
            print(f"{finding.path}:{finding.line}: {finding.word!r}; use: {replacement(finding.word)}")
    return 1 if findings else 0


def tracked_files() -> list[str]:
    """Return the paths of the files that git tracks or would add."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return sorted(path for path in set(listed) if (ROOT / path).is_file())


def check_files(paths: Iterable[str], root: Path = ROOT) -> Iterator[Finding]:
    """Yield every banned word in the text files at `paths`, which are relative to `root`."""
    for path in paths:
        if path in EXCLUDED:
            continue
        try:
            text = (root / path).read_text(encoding="utf-8")
        except UnicodeDecodeError:  # a picture, or weights
            continue
        yield from check_text(path, text)


def check_text(path: str, text: str) -> Iterator[Finding]:
    """Yield every banned word in `text`, the content of `path`."""
    for number, line in enumerate(text.splitlines(), start=1):
        for match in _WORD.finditer(line):
            yield Finding(path, number, match.group())


def replacement(word: str) -> str:
    """Return the terms to use in place of `word`."""
    return next(terms for pattern, terms in BANNED.items() if re.fullmatch(pattern, word, re.IGNORECASE))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

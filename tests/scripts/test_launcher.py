"""The launcher sets up once, repairs an interrupted set-up, and else only forwards. `uv` and Python are fakes."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parents[2]

FAKE_PYTHON = """#!/bin/bash
[[ $1 == -c ]] && exit 0
echo "in $PWD with: $*"
exit "${FAKE_EXIT:-0}"
"""
FAKE_UV = """#!/bin/bash
if [[ $1 == --version ]]; then echo "uv ${FAKE_UV_VERSION:-99.0.0}"; exit; fi
echo "$*" >>"$FAKE_LOG"
mkdir -p "$UV_PROJECT_ENVIRONMENT/bin"
[[ -n ${FAKE_KILLED:-} ]] && kill -KILL $$
[[ -n ${FAKE_FAILS:-} ]] && exit 2
cp "$(dirname "$0")/fake_python" "$UV_PROJECT_ENVIRONMENT/bin/python"
"""


@dataclass
class Checkout:
    """A copy of the launcher with fake tools."""

    root: Path
    tools: Path

    def run(self, *arguments: str, cwd: Path | None = None, command: Path | None = None, **environment: str):
        return subprocess.run(
            [command or self.root / "z1", *arguments],
            cwd=cwd or self.root,
            env=self.environment(**environment),
            capture_output=True,
            text=True,
            check=False,
        )

    def environment(self, **more: str) -> dict[str, str]:
        path = f"{self.tools}:{os.environ['PATH']}"
        return {**os.environ, "PATH": path, "FAKE_LOG": str(self.tools / "log"), **more}

    def syncs(self) -> int:
        log = self.tools / "log"
        return len(log.read_text().splitlines()) if log.exists() else 0


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    root, tools = tmp_path / "a check out", tmp_path / "tools"
    root.mkdir()
    tools.mkdir()
    shutil.copy(ROOT / "z1", root / "z1")
    (root / "uv.lock").write_text("locked")
    (root / "pyproject.toml").write_text("project")
    for name, text in (("uv", FAKE_UV), ("fake_python", FAKE_PYTHON)):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    return Checkout(root, tools)


def test_first_start_sets_up_with_a_message_and_the_second_is_silent(checkout: Checkout) -> None:
    first, second = checkout.run("--version"), checkout.run("--version")
    assert "GB" in first.stderr
    assert (first.returncode, second.returncode, second.stderr) == (0, 0, "")
    assert checkout.syncs() == 1
    assert "sync --frozen --compile-bytecode" in (checkout.tools / "log").read_text()


def test_arguments_folder_and_exit_code_pass_through_a_symlink(checkout: Checkout, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    link = elsewhere / "linked"
    link.symlink_to(checkout.root / "z1")
    done = checkout.run("demo", "a b", "", "*", cwd=elsewhere, command=link, FAKE_EXIT="7")
    assert done.returncode == 7
    assert done.stdout == f"in {elsewhere} with: -P -m scripts.cli demo a b  *\n"


def test_new_lock_sets_up_again(checkout: Checkout) -> None:
    checkout.run()
    (checkout.root / "uv.lock").write_text("locked again")
    checkout.run()
    assert checkout.syncs() == 2


def test_moved_folder_sets_up_again(checkout: Checkout) -> None:
    checkout.run()
    checkout.root = checkout.root.rename(checkout.root.with_name("moved"))
    assert checkout.run().returncode == 0
    assert checkout.syncs() == 2


def test_failed_set_up_is_one_clear_error_and_the_next_start_tries_again(checkout: Checkout) -> None:
    failed = checkout.run(FAKE_FAILS="1")
    assert failed.returncode == 1
    assert "error: the environment could not be built" in failed.stderr
    assert checkout.run().returncode == 0


def test_killed_set_up_is_removed_and_built_again(checkout: Checkout) -> None:
    checkout.run(FAKE_KILLED="1")
    half = checkout.root / ".venv" / "half a package"
    half.touch()
    repaired = checkout.run()
    assert repaired.returncode == 0
    assert "incomplete" in repaired.stderr
    assert not half.exists()


def test_two_first_starts_at_once_set_up_once(checkout: Checkout) -> None:
    command = [checkout.root / "z1", "--version"]
    both = [subprocess.Popen(command, env=checkout.environment(), stderr=subprocess.DEVNULL) for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    assert checkout.syncs() == 1


def test_other_packages_on_the_path_are_kept_out(checkout: Checkout) -> None:
    (checkout.tools / "fake_python").write_text('#!/bin/bash\necho "path: ${PYTHONPATH-none}"\n')
    assert checkout.run(PYTHONPATH="/opt/ros/lib").stdout == "path: none\n"


def test_the_shells_choice_of_gl_is_kept_out(checkout: Checkout) -> None:
    (checkout.tools / "fake_python").write_text('#!/bin/bash\necho "${MUJOCO_GL-none} ${PYOPENGL_PLATFORM-none}"\n')
    assert checkout.run(MUJOCO_GL="osmesa", PYOPENGL_PLATFORM="osmesa").stdout == "none none\n"


def test_set_up_works_without_flock(checkout: Checkout) -> None:
    tools = checkout.tools / "few"
    tools.mkdir()
    for name in ("bash", "readlink", "cksum", "mkdir", "mv", "rm", "cp", "dirname", "sort", "head", "df", "awk"):
        (tools / name).symlink_to(str(shutil.which(name)))
    (tools / "python3").symlink_to(checkout.tools / "fake_python")
    done = checkout.run("--version", PATH=f"{checkout.tools}:{tools}")
    assert done.returncode == 0, done.stderr
    assert checkout.syncs() == 1


def test_without_a_suitable_python_the_error_names_the_package(checkout: Checkout) -> None:
    for name in ("python3", "python3.11", "python3.12", "python3.13", "python3.14", "python"):
        (checkout.tools / name).write_text('#!/bin/bash\n[[ $1 == --version ]] && echo "Python 3.9.2"\nexit 1\n')
        (checkout.tools / name).chmod(0o755)
    done = checkout.run()
    assert done.returncode == 1
    assert "installed: Python 3.9.2" in done.stderr
    assert "apt install" in done.stderr
    assert checkout.syncs() == 0


def test_old_uv_is_not_used(checkout: Checkout) -> None:
    (checkout.tools / "python3").write_text('#!/bin/bash\n[[ $1 == -c ]] && exit 0\necho "called with $*"\nexit 1\n')
    (checkout.tools / "python3").chmod(0o755)
    done = checkout.run(FAKE_UV_VERSION="0.1.0")
    assert done.returncode == 1
    assert "'uv' could not be downloaded" in done.stderr
    assert checkout.syncs() == 0

"""The rules of the house that a reader of the code cannot see in one place: who imports whom, who knows the time."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("scripts", "sim_twin", "z1_runtime", "hal", "models", "calibration")
ALLOWED: dict[str, set[str]] = {
    "hal": set(),
    "models": set(),
    "calibration": set(),
    "z1_runtime": {"hal", "models", "calibration"},
    "sim_twin": {"hal"},
    "sim_twin/bench": {"hal", "models", "z1_runtime"},
    "scripts": set(ROOMS),
}
TIMELESS_ROOMS = ("hal", "z1_runtime", "models", "sim_twin", "calibration")
MAY_KNOW_THE_TIME = ("hal/clock.py",)
READS_THE_TIME = {
    "time": {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "sleep"},
    "datetime": {"now", "utcnow", "today"},
    "asyncio": {"sleep"},
}


def sources(*rooms: str) -> list[Path]:
    return sorted(path for room in rooms for path in (ROOT / room).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imported_modules(tree: ast.AST) -> Iterator[tuple[str, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: imports are absolute"
            yield str(node.module), node.lineno


def forbidden_imports(name: str, source: str) -> list[str]:
    """Which imports of a module called `name` (a path from the root) point the wrong way."""
    room = name.split("/", maxsplit=1)[0]
    allowed = {room} | ALLOWED["sim_twin/bench" if name.startswith("sim_twin/bench/") else room]
    return [
        f"{name}:{line} imports {module}"
        for module, line in imported_modules(ast.parse(source))
        if module.split(".")[0] in ROOMS and module.split(".")[0] not in allowed
    ]


def uses_of_the_time(name: str, source: str) -> list[str]:
    """Where a module reads the wall clock or sleeps, however it imported what it uses."""
    tree = ast.parse(source)
    modules: dict[str, str] = {}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.asname or alias.name: alias.name for alias in node.names if alias.name in READS_THE_TIME}
        elif isinstance(node, ast.ImportFrom) and node.module in READS_THE_TIME:
            for alias in node.names:
                if alias.name in READS_THE_TIME[node.module]:
                    found.append(f"{name}:{node.lineno} imports {alias.name} of {node.module}")
                else:  # the class datetime.datetime, whose methods read the time as the module's do
                    modules[alias.asname or alias.name] = node.module
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute):
            continue
        owner = node.value
        while isinstance(owner, ast.Attribute):
            owner = owner.value
        if isinstance(owner, ast.Name) and node.attr in READS_THE_TIME.get(modules.get(owner.id, ""), ()):
            found.append(f"{name}:{node.lineno} uses {modules[owner.id]}.{node.attr}")
    return found


@pytest.mark.parametrize("path", sources(*ROOMS), ids=name_of)
def test_imports_run_down_only(path: Path) -> None:
    assert forbidden_imports(name_of(path), path.read_text()) == []


@pytest.mark.parametrize("path", sources(*TIMELESS_ROOMS), ids=name_of)
def test_only_the_clock_knows_the_time_or_sleeps(path: Path) -> None:
    if name_of(path) in MAY_KNOW_THE_TIME:
        assert uses_of_the_time(name_of(path), path.read_text()) != []
    else:
        assert uses_of_the_time(name_of(path), path.read_text()) == []


def uses_of_waypoints(source: str) -> list[int]:
    """Lines that use Ruckig's waypoints, as an attribute, a keyword or a name in quotes."""
    word = "intermediate_" + "positions"
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if (isinstance(node, ast.Attribute) and node.attr == word)
        or (isinstance(node, ast.keyword) and node.arg == word)
        or (isinstance(node, ast.Constant) and node.value == word)
    ]


@pytest.mark.parametrize("path", sources(*ROOMS), ids=name_of)
def test_nobody_gives_ruckig_waypoints_which_its_wheel_sends_to_a_cloud(path: Path) -> None:
    assert uses_of_waypoints(path.read_text()) == []


def test_a_use_of_waypoints_would_be_found() -> None:
    word = "intermediate_" + "positions"
    assert len(uses_of_waypoints(f"inp.{word} = [q]\nsetattr(inp, '{word}', [q])\nplan({word}=[q])")) == 3


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("hal/x.py", "import models.types"),
        ("models/x.py", "def f():\n    from hal import z1"),
        ("z1_runtime/x.py", "from sim_twin.world import World"),
        ("sim_twin/x.py", "import z1_runtime"),
        ("calibration/x.py", "import scripts"),
    ],
)
def test_a_wrong_import_would_be_found(name: str, source: str) -> None:
    assert len(forbidden_imports(name, source)) == 1


def test_the_benchmark_alone_may_join_the_twin_and_the_runtime() -> None:
    assert forbidden_imports("sim_twin/bench/episode.py", "from z1_runtime import pipeline") == []


@pytest.mark.parametrize(
    "source",
    [
        "import time\ntime.sleep(1)",
        "import time as t\nnow = t.monotonic",
        "from time import perf_counter",
        "import datetime\ndatetime.datetime.now()",
        "from datetime import datetime\ndatetime.now()",
        "import asyncio\nasync def f():\n    await asyncio.sleep(1)",
    ],
)
def test_a_use_of_the_time_would_be_found(source: str) -> None:
    assert len(uses_of_the_time("x.py", source)) == 1

"""Rules that no single file shows: dependencies, cycles, folder sizes, and where the time is read."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("scripts", "sim_twin", "z1_runtime", "hal", "models", "calibration")
ALLOWED: dict[str, set[str]] = {
    "hal": {"hal"},
    "models": {"models", "hal/base"},
    "calibration": {"calibration", "hal/base"},
    "z1_runtime": {"z1_runtime", "hal", "models", "calibration"},
    "sim_twin": {"sim_twin", "hal"},
    "sim_twin/benchmark": {"sim_twin", "hal", "models", "z1_runtime"},
    "scripts": set(ROOMS),
}
"""Package to what it may import; the longest matching package counts."""
MAX_FILES = 16
"""Modules in a folder, `__init__` not counted; more than that is a folder that was not made."""
MAX_LOADED = 70
"""Modules that a lock-step pick loads, the twin's and the detector's included, `__init__` not counted."""
TIMELESS_ROOMS = ("hal", "z1_runtime", "models", "sim_twin", "calibration")
MAY_READ_THE_TIME = ("hal/base/clock.py",)
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


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}/")


def forbidden_imports(name: str, source: str) -> list[str]:
    """Return the imports of the module at `name` (a path from the root) that its package may not have."""
    allowed = ALLOWED[max((package for package in ALLOWED if within(name, package)), key=len)]
    return [
        f"{name}:{line} imports {module}"
        for module, line in imported_modules(ast.parse(source))
        if module.split(".")[0] in ROOMS and not any(within(module.replace(".", "/"), package) for package in allowed)
    ]


def module_graph(files: dict[str, str]) -> dict[str, set[str]]:
    """Return which modules each module imports; lazy and type-only imports count.

    Args:
        files: source by path from the root.
    """
    names = {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): name for name in files}
    graph: dict[str, set[str]] = {module: set() for module in names}
    for module, name in names.items():
        for node in ast.walk(ast.parse(files[name])):
            if isinstance(node, ast.Import):
                wanted = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                # `from package import module` and `from module import name` look alike
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                wanted = [each if each in names else str(node.module) for each in inner]
            else:
                continue
            graph[module] |= {each for each in wanted if each in names and each != module}
    return graph


def folder_graph(modules: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the imports between folders; a module at the top of a package counts as a folder of its own."""

    def folder(module: str) -> str:
        parts = module.split(".")
        return module if len(parts) <= 2 else ".".join(parts[:-1])

    graph: dict[str, set[str]] = {}
    for module, imported in modules.items():
        graph.setdefault(folder(module), set()).update(folder(each) for each in imported)
    return {one: others - {one} for one, others in graph.items()}


def cycles(graph: dict[str, set[str]]) -> list[str]:
    """Return every cycle that a topological sort meets, one after the other."""
    found, graph = [], {one: set(others) for one, others in graph.items()}
    while True:
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            loop = error.args[1]
            found.append(" <- ".join(loop))
            graph[loop[1]].discard(loop[0])
        else:
            return found


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


@pytest.mark.integration
def test_imports_run_down_only() -> None:
    assert [bad for path in sources(*ROOMS) for bad in forbidden_imports(name_of(path), path.read_text())] == []


@pytest.mark.integration
def test_no_import_cycle_between_modules_or_folders() -> None:
    modules = module_graph({name_of(path): path.read_text() for path in sources(*ROOMS)})
    assert cycles(modules) == []
    assert cycles(folder_graph(modules)) == []


@pytest.mark.parametrize("folder", sorted({path.parent for path in sources(*ROOMS, "tests")}), ids=name_of)
def test_a_folder_fits_one_look(folder: Path) -> None:
    modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
    assert len(modules) <= MAX_FILES


def test_only_the_clock_reads_the_time_or_sleeps() -> None:
    uses = {name_of(path): uses_of_the_time(name_of(path), path.read_text()) for path in sources(*TIMELESS_ROOMS)}
    assert {name for name, found in uses.items() if found} == set(MAY_READ_THE_TIME), uses


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


def test_ruckig_gets_no_waypoints_since_its_wheel_sends_them_to_a_cloud() -> None:
    assert [name_of(path) for path in sources(*ROOMS) if uses_of_waypoints(path.read_text())] == []


def test_a_use_of_waypoints_would_be_found() -> None:
    word = "intermediate_" + "positions"
    assert len(uses_of_waypoints(f"inp.{word} = [q]\nsetattr(inp, '{word}', [q])\nplan({word}=[q])")) == 3


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("hal/x.py", "import models.types"),
        ("models/x.py", "def f():\n    from hal.servo import servo"),
        ("z1_runtime/x.py", "from sim_twin.model.world import World"),
        ("sim_twin/x.py", "import z1_runtime"),
        ("calibration/x.py", "import scripts"),
    ],
)
def test_a_wrong_import_would_be_found(name: str, source: str) -> None:
    assert len(forbidden_imports(name, source)) == 1


@pytest.mark.parametrize("source", ["def f():\n    from hal import b", "if TYPE_CHECKING:\n    import hal.b"])
def test_a_lazy_or_type_only_cycle_would_be_found(source: str) -> None:
    assert len(cycles(module_graph({"hal/a.py": source, "hal/b.py": "from hal.a import x"}))) == 1


def test_a_cycle_between_folders_would_be_found() -> None:
    files = {
        "hal/one/a.py": "import hal.two.b",
        "hal/two/b.py": "",
        "hal/two/c.py": "import hal.one.d",
        "hal/one/d.py": "",
    }
    assert cycles(module_graph(files)) == []
    assert len(cycles(folder_graph(module_graph(files)))) == 1


LIST_LOADED = """
import sys
from z1_runtime import Robot

with Robot.simulate("bottle") as robot:
    assert robot.pick().held
print(*sorted(name for name in sys.modules if getattr(sys.modules[name], "__file__", None)), sep="\\n")
"""


@pytest.mark.integration
def test_a_lock_step_pick_loads_few_modules() -> None:
    loaded = subprocess.run(
        [sys.executable, "-c", LIST_LOADED], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    paths = [ROOT / (name.replace(".", "/") + ".py") for name in loaded if name.split(".")[0] in ROOMS]
    ours = [name_of(path) for path in paths if path.is_file()]
    assert 50 < len(ours) <= MAX_LOADED, ours


def test_the_benchmark_alone_may_join_the_twin_and_the_runtime() -> None:
    assert forbidden_imports("sim_twin/benchmark/episodes/episode.py", "from z1_runtime import types") == []


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

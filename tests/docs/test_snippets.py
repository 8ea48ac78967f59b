"""The documentation against the code: snippets run, commands and modules exist, links resolve."""

from __future__ import annotations

import ast
import re
import shlex
import tomllib
import warnings
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml

from scripts.cli import COMMANDS
from scripts.commands.stop_arm import parse as parse_stop
from z1_runtime.config import RuntimeConfig, config_from

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
MAX_README_LINES = 120
MAX_PICTURE_BYTES = 3_000_000
NOT_RUN = 0
"""Python blocks that need hardware, marked by a comment on the line before the fence."""
TWIN = {"run-script": "scripts.commands.run_script", "wire": "scripts.commands.run_wire"}

_FENCE = re.compile(
    r"^(?P<marker><!-- no-run -->\n)?```(?P<language>\w*)\n(?P<body>.*?)^```$", flags=re.DOTALL | re.MULTILINE
)
_INLINE = re.compile(r"`([^`\n]+)`")
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(language: str) -> Iterator[tuple[Path, int, str, bool]]:
    """Yield (page, line, text, marked as not to be run) of each block in `language`."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in _FENCE.finditer(text):
            if match["language"] == language:
                yield page, text[: match.start("body")].count("\n") + 1, match["body"], match["marker"] is not None


def shell_lines(page: Path) -> Iterator[str]:
    """Yield the command lines of `page`, from blocks (continued lines joined, comments removed) and from the text."""
    text = page.read_text(encoding="utf-8")
    for match in _FENCE.finditer(text):
        if match["language"] in ("bash", ""):
            yield from match["body"].replace("\\\n", " ").splitlines()
    yield from _INLINE.findall(_FENCE.sub("", text))


def commands(prefix: str) -> list[str]:
    """Return all different command lines that begin with `prefix`."""
    found = {line.strip() for page in PAGES for line in shell_lines(page) if line.strip().startswith(prefix)}
    return sorted(found)


def parse(config_type: Any, arguments: list[str]) -> None:
    """Check `arguments` against the options of `config_type`; nothing is constructed, so no file has to exist."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(config_type)
    parser.parse_args(arguments)


def check_command(line: str) -> None:
    """Check the command and the options of one `./z1 …` line."""
    _, *arguments = shlex.split(line.split(" > ", maxsplit=1)[0], comments=True)
    name, *rest = arguments or ["--help"]
    if name in ("COMMAND", "--help", "--version"):
        return
    assert name in COMMANDS, f"there is no command {name!r}"
    if name == "test":
        check_pytest_options(rest)
        return
    if name == "stop":  # which does without tyro, to be quick
        parse_stop(rest)
        return
    module_name = COMMANDS[name][0]
    if name == "twin" and rest:
        step, *rest = rest
        module_name = TWIN[step]
        rest = rest[: next((i for i, each in enumerate(rest, 1) if each.endswith(".py")), len(rest))]
    if rest or name not in ("twin", "calibrate", "tune"):  # named alone, these stand for all their steps
        parse(import_module(module_name).Config, rest)


def check_pytest_options(options: list[str]) -> None:
    """Check that only known markers are selected."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    known = {marker.partition(":")[0] for marker in settings["markers"]}
    words = {word for option in options if option != "-m" for word in option.split()} - {"not", "and", "or"}
    assert words <= known


@pytest.mark.integration
@pytest.mark.parametrize(
    "block", [pytest.param(block, id=f"{name_of(block[0])}:{block[1]}") for block in blocks("python")]
)
def test_python_block_runs(block: tuple[Path, int, str, bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, line, source, marked = block
    if marked:
        pytest.skip("needs hardware")
    monkeypatch.chdir(tmp_path)
    exec(compile("\n" * line + source, str(page), "exec"), {"__name__": "snippet"})  # tracebacks show the page's line


def test_every_python_block_is_python_and_imports_what_exists() -> None:
    for page, line, source, _ in blocks("python"):
        tree = ast.parse("\n" * line + source, str(page))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = import_module(node.module)
                for name in node.names:
                    assert hasattr(module, name.name), f"{name_of(page)}:{node.lineno}"


def test_only_hardware_exempts_a_block() -> None:
    assert sum(marked for *_, marked in blocks("python")) == NOT_RUN


@pytest.mark.integration
@pytest.mark.parametrize("line", commands("./z1"))
def test_command_line_is_accepted(line: str) -> None:
    check_command(line)


@pytest.mark.parametrize(
    "line", ["./z1 fly", "./z1 demo --wings", "./z1 demo --crop circle", "./z1 twin wire --depth sea"]
)
def test_wrong_command_line_would_be_found(line: str) -> None:
    with pytest.raises((AssertionError, SystemExit)):
        check_command(line)


@pytest.mark.parametrize("line", sorted({*commands("python -m"), *commands(".venv/bin/python -m")}))
def test_module_exists_with_its_options(line: str) -> None:
    _, _, module_name, *arguments = shlex.split(line, comments=True)
    assert find_spec(module_name) is not None
    config_type = getattr(import_module(module_name), "Config", None)
    if config_type is not None and arguments:
        parse(config_type, arguments)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_images_exist(page: Path) -> None:
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    missing = [target for target in _LINK.findall(text) if not link_exists(page, target)]
    assert missing == []


def link_exists(page: Path, target: str) -> bool:
    if target.startswith(("http://", "https://", "../../actions/")):  # the last is GitHub's own path of a workflow
        return True
    path, _, anchor = target.partition("#")
    file = (page.parent / path).resolve() if path else page
    if not file.exists():
        return False
    return not anchor or anchor in anchors(file)


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of `page`, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.+)$", _FENCE.sub("", page.read_text(encoding="utf-8")), flags=re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def test_missing_link_would_be_found() -> None:
    page = ROOT / "docs" / "benchmark.md"
    assert link_exists(page, "safety-and-faults.md#injected-faults")
    assert not link_exists(page, "safety-and-faults.md#no-such-heading")
    assert not link_exists(page, "no-such-page.md")


def test_named_paths_exist() -> None:
    packages = ("hal/", "models/", "calibration/", "z1_runtime/", "sim_twin/", "scripts/", "tests/", "docs/images/")
    names = {name for page in PAGES for name in _INLINE.findall(_FENCE.sub("", page.read_text(encoding="utf-8")))}
    paths = {name for name in names if name.startswith(packages) and " " not in name}
    assert len(paths) > 20
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


@pytest.mark.parametrize(
    "block", [pytest.param(block, id=f"{name_of(block[0])}:{block[1]}") for block in blocks("yaml")]
)
def test_configuration_block_loads(block: tuple[Path, int, str, bool]) -> None:
    page, line, source, _ = block
    assert config_from(yaml.safe_load(source), f"{name_of(page)}:{line}") != RuntimeConfig()


def test_documented_settings_exist_with_their_defaults() -> None:
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    table = page[page.index("| key |") : page.index("`./z1 show-config` lists all keys")]
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \|", table, flags=re.MULTILINE)
    settings = asdict(RuntimeConfig())
    assert len(rows) > 10
    for key, default in rows:
        assert key in settings
        if default != "–":
            assert yaml.safe_load(default.strip("`")) == settings[key]


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = set(re.findall(r": ([\w-]+\.md)$", text, flags=re.MULTILINE))
    assert named == {page.name for page in (ROOT / "docs").glob("*.md")}


def test_readme_is_short_and_its_picture_small() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_README_LINES
    assert (ROOT / "docs" / "images" / "demo.webp").stat().st_size < MAX_PICTURE_BYTES


def test_every_command_is_in_the_readme() -> None:
    named = {line.split()[1] for line in commands("./z1") if len(line.split()) > 1}
    assert set(COMMANDS) - named == set()


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=name_of)
def test_issue_template_is_complete(path: Path) -> None:
    template = yaml.safe_load(path.read_text(encoding="utf-8"))
    if path.name == "config.yml":
        assert set(template) == {"blank_issues_enabled"}
        return
    assert {"name", "description", "body"} <= set(template)
    fields = [field for field in template["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields)


def test_citation_names_the_version_of_the_package() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], "Apache-2.0")
    assert [author["family-names"] for author in citation["preferred-citation"]["authors"]] == [
        "Poudel",
        "Basit",
        "Shafique",
    ]

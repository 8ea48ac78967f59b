"""The command line: fast to start, one line for an expected error, a traceback for a defect."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import version
from types import ModuleType

import numpy as np
import pytest

from hal.base.errors import HalTimeoutError, InvalidValueError, OutputExistsError, UnknownBackendError
from models.obb.obb import DegenerateCloudError
from scripts import cli
from scripts.commands.stop_arm import NOTHING_WAS_STOPPED


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a made-up command."""

    n: int = 1

    def __post_init__(self) -> None:
        if self.n < 0:
            raise InvalidValueError(f"n is {self.n}; allowed is 0 and more.")


Options.__module__ = "scripts.made_up"


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return a command `made-up`, whose `main` the test fills in."""
    module = ModuleType("scripts.made_up", "Made up.")
    module.Config = Options  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "scripts.made_up", module)
    monkeypatch.setitem(cli.COMMANDS, "made-up", ("scripts.made_up", "for a test"))
    monkeypatch.delenv("Z1_DEBUG", raising=False)
    return module


def raise_in(module: str, error: BaseException):
    """Return a `main` that raises `error` from a line of `module`."""
    scope = {"__name__": module, "error": error}
    exec("def main(config):\n    raise error", scope)
    return scope["main"]


def test_every_command_is_a_module_with_a_main() -> None:
    from importlib import import_module

    for module, _ in cli.COMMANDS.values():
        assert callable(import_module(module).main)


def test_help_lists_every_command_and_loads_no_large_package() -> None:
    program = (
        "import sys; from scripts.cli import main; main(['--help']); "
        "large = {'mujoco', 'torch', 'numpy', 'rerun', 'zenoh', 'tyro'} & set(sys.modules); assert not large, large"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert all(f"  {name} " in done.stdout for name in cli.COMMANDS)


def test_version_is_the_package_s(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert version("z1-grasp") in capsys.readouterr().out


def test_unknown_command_names_the_nearest_and_all_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dmeo"]) == 2
    error = capsys.readouterr().err
    assert "Did you mean `demo`?" in error
    assert "doctor" in error


def test_no_command_shows_the_usage_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: ./z1 COMMAND" in capsys.readouterr().out


def test_options_reach_the_command_and_its_code_comes_back(made_up: ModuleType) -> None:
    made_up.main = lambda config: config.n  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["made-up", "--n", "7"]) == 7


@pytest.mark.parametrize(
    ("module", "error", "code"),
    [
        ("hal.servo.servo", HalTimeoutError("no answer"), 1),
        ("numpy", DegenerateCloudError("four points at least"), 1),
        ("hal.rig", UnknownBackendError("arm", "x", ["mock"]), 2),
        ("z1_runtime.config", InvalidValueError("alpha is 3"), 2),
        ("scripts.commands.run_demo", PermissionError("out cannot be written"), 1),
        ("sim_twin.benchmark.results.store", OutputExistsError("out holds rows already"), 2),
    ],
)
def test_error_for_the_user_is_one_line(
    made_up: ModuleType, capsys: pytest.CaptureFixture[str], module: str, error: Exception, code: int
) -> None:
    made_up.main = raise_in(module, error)  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["made-up"]) == code
    assert capsys.readouterr().err == f"error: {error}\n"


@pytest.mark.parametrize("module", ["numpy.linalg", "json"])
def test_defect_shows_its_traceback(made_up: ModuleType, capsys: pytest.CaptureFixture[str], module: str) -> None:
    made_up.main = raise_in(module, ValueError("a defect"))  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["made-up"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_value_error_from_inside_a_library_is_a_defect(made_up: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    made_up.main = lambda config: np.random.default_rng().integers(0, -1)  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["made-up"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_debug_shows_the_traceback_of_any_error(
    made_up: ModuleType, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("Z1_DEBUG", "1")
    made_up.main = raise_in("hal.servo.servo", HalTimeoutError("no answer"))  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["made-up"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_interrupt_exits_130(made_up: ModuleType) -> None:
    made_up.main = raise_in("hal.servo.servo", KeyboardInterrupt())  # pyright: ignore[reportAttributeAccessIssue]
    assert cli.main(["made-up"]) == 130


def test_stop_without_a_hal_process_is_one_clear_error(capsys: pytest.CaptureFixture[str]) -> None:
    for command, text in (("stop", NOTHING_WAS_STOPPED), ("rearm", "no HAL process answers at tcp/127.0.0.1:1")):
        assert cli.main([command, "--port", "1", "--connect-timeout-s", "0.1"]) == 1
        assert text in capsys.readouterr().err.splitlines()[0]


def test_bad_option_value_of_ours_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["rearm", "--robot", "no spaces"]) == 2
    assert "allowed 1 to 40 letters" in capsys.readouterr().err

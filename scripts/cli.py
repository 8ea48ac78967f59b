"""`./z1 COMMAND`: finds the command, hands it its arguments, and turns expected errors into one line."""

from __future__ import annotations

import difflib
import os
import sys
import traceback
from importlib import import_module
from importlib.metadata import version

from hal.base.errors import UsageError, Z1Error

COMMANDS = {
    "demo": ("scripts.commands.run_demo", "the twin sees an object and lifts it, end to end"),
    "run": ("scripts.commands.run_runtime", "see, plan and move, against a HAL that runs already"),
    "bench": ("scripts.commands.run_benchmark", "the paper's 81 scenarios: success by method, with intervals"),
    "tune": (
        "scripts.commands.run_tune",
        "fit the ranking to logged episodes; keep what is set by hand unless that loses",
    ),
    "oracle": (
        "scripts.commands.find_reachable_grasps",
        "which of the scenarios can be solved at all, by search on the truth",
    ),
    "hal": ("scripts.commands.run_hal", "serve the arm and the camera, with the servo loop and its limits"),
    "calibrate": (
        "scripts.calibrate.calibrate",
        "the wrist camera, with a printed board: hand-eye, intrinsics, touch test",
    ),
    "twin": (
        "scripts.commands.run_twin",
        "the twin in place of a device: run-script for pyrealsense2, wire for a Z1's clients",
    ),
    "stop": ("scripts.commands.stop_arm", "stop the arm now; it stays stopped until re-armed"),
    "rearm": ("scripts.commands.rearm_arm", "lift the stop, after somebody has looked at the arm"),
    "doctor": ("scripts.commands.doctor", "what of this machine is ready, and how to fix the rest"),
    "show-config": ("scripts.commands.show_config", "every setting in force and where it came from"),
    "test": ("scripts.commands.run_tests", "run the tests; pytest's options may follow"),
    "check": ("scripts.commands.check_code", "lint, format and types, as CI does it"),
}
"""Name to (module, help). A module holds `main(config) -> int` and, as `Config`, the dataclass of its options; one
without `Config` takes the bare arguments: `main(list[str]) -> int`."""

FAILED, BAD_USAGE, INTERRUPTED = 1, 2, 130


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 1 failed, 2 bad usage or configuration, 130 interrupted."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or [""]
    if name in ("", "-h", "--help", "help"):
        print(_usage())
        return 0 if name else BAD_USAGE
    if name in ("-V", "--version"):
        print(f"z1-grasp {version('z1-grasp')}")
        return 0
    if name not in COMMANDS:
        print(f"error: {_unknown(name)}", file=sys.stderr)
        return BAD_USAGE
    return _run_guarded(name, rest)


def _run_guarded(name: str, arguments: list[str]) -> int:
    try:
        return _run(name, arguments)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # `./z1 doctor | head`: the reader has gone, which is no error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        expected = isinstance(error, Z1Error | OSError)  # ours, or the file system's; anything else is a defect
        if os.environ.get("Z1_DEBUG") == "1" or not expected:
            traceback.print_exc()
        else:
            print(f"error: {error}", file=sys.stderr)
        return BAD_USAGE if isinstance(error, UsageError) else FAILED


def _run(name: str, arguments: list[str]) -> int:
    module = import_module(COMMANDS[name][0])
    config_type = getattr(module, "Config", None)
    if config_type is None:
        return module.main(arguments)
    import tyro

    return module.main(tyro.cli(config_type, prog=f"z1 {name}", description=module.__doc__, args=arguments))


def _unknown(name: str) -> str:
    near = difflib.get_close_matches(name, COMMANDS, n=1)
    guess = f" Did you mean `{near[0]}`?" if near else ""
    return f"there is no command {name!r}.{guess} Known: {', '.join(COMMANDS)}."


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name:<{width}}  {help_}" for name, (_, help_) in COMMANDS.items())
    return f"""usage: ./z1 COMMAND [options]

A Unitree Z1 with a wrist camera grasps what it sees; without an arm, its digital twin does.

{lines}

  ./z1 COMMAND --help   the options of a command
  ./z1 --version        the version

Exit codes: 0 done, 1 failed, 2 bad usage or configuration, 130 interrupted. Z1_DEBUG=1 shows tracebacks."""


if __name__ == "__main__":
    sys.exit(main())

"""`./z1 COMMAND`: finds the command, hands it its arguments, and turns expected errors into one line."""

from __future__ import annotations

import difflib
import os
import sys
import traceback
from importlib import import_module
from importlib.metadata import version
from types import TracebackType

COMMANDS = {
    "demo": ("scripts.run_demo", "the twin sees an object and lifts it, end to end"),
    "run": ("scripts.run_runtime", "see, plan and move, against a HAL that runs already"),
    "bench": ("scripts.run_benchmark", "the paper's 81 scenarios: success by method, with intervals"),
    "tune": ("scripts.run_tune", "fit the ranking to logged episodes; keep what is set by hand unless that loses"),
    "oracle": ("scripts.find_reachable_grasps", "which of the scenarios can be solved at all, by search on the truth"),
    "hal": ("scripts.run_hal", "serve the arm and the camera, with the servo loop and its limits"),
    "calibrate": ("scripts.calibrate", "the wrist camera, with a printed board: hand-eye, intrinsics, touch test"),
    "twin": ("scripts.run_twin", "the twin in place of a device: run-script for pyrealsense2, wire for a Z1's clients"),
    "stop": ("scripts.stop_arm", "stop the arm now; it stays stopped until re-armed"),
    "rearm": ("scripts.rearm_arm", "lift the stop, after somebody has looked at the arm"),
    "doctor": ("scripts.doctor", "what of this machine is ready, and how to fix the rest"),
    "show-config": ("scripts.show_config", "every setting in force and where it came from"),
    "test": ("scripts.run_tests", "run the tests; pytest's options may follow"),
    "check": ("scripts.check_code", "lint, format and types, as CI does it"),
}
"""Name to (module, help). A module holds `main(config) -> int` and, as `Config`, the dataclass of its options; one
without `Config` takes the bare arguments: `main(list[str]) -> int`."""

ROOMS = ("hal", "models", "calibration", "z1_runtime", "sim_twin", "scripts")

BAD_INPUT = {"ConfigError", "ScoringError", "TuneError", "UnknownBackendError", "ViewerPortError"}
"""Errors of ours that say the call was wrong, not that the work failed; so are a plain `ValueError` and
a `FileExistsError` of our own."""

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
        if os.environ.get("Z1_DEBUG") == "1" or not is_for_the_user(error):
            traceback.print_exc()
        else:
            print(f"error: {error}", file=sys.stderr)
        return BAD_USAGE if is_for_the_user(error) and _is_bad_input(error) else FAILED


def _run(name: str, arguments: list[str]) -> int:
    module = import_module(COMMANDS[name][0])
    config_type = getattr(module, "Config", None)
    if config_type is None:
        return module.main(arguments)
    import tyro

    return module.main(tyro.cli(config_type, prog=f"z1 {name}", description=module.__doc__, args=arguments))


def is_for_the_user(error: BaseException) -> bool:
    """Return whether the message of `error` was written for the person at the keyboard.

    It was when we made the class, or when one of our own lines raised a `ValueError` or `OSError`. Anything else,
    such as a `ValueError` from inside NumPy, is a defect and shows its traceback.
    """
    if _room(type(error).__module__) in ROOMS:
        return True
    return isinstance(error, ValueError | OSError) and _raised_in(error.__traceback__) in ROOMS


def _is_bad_input(error: BaseException) -> bool:
    return type(error) in (ValueError, FileExistsError) or type(error).__name__ in BAD_INPUT


def _raised_in(traceback_: TracebackType | None) -> str:
    while traceback_ is not None and traceback_.tb_next is not None:
        traceback_ = traceback_.tb_next
    return _room(traceback_.tb_frame.f_globals.get("__name__", "")) if traceback_ else ""


def _room(module: str) -> str:
    return module.partition(".")[0]


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

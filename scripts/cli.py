"""`./z1 COMMAND`: dispatch to the command's module, with expected errors as one line."""

from __future__ import annotations

import os
import sys
import traceback
from importlib import import_module

from hal.base.errors import UsageError, Z1Error

# Modules by name: a command loads only its own, neither the simulator nor the networks of the others.
COMMANDS = {
    "demo": ("scripts.commands.run_demo", "pick an object with the twin, end to end"),
    "run": ("scripts.commands.run_runtime", "pick an object with a running HAL"),
    "bench": ("scripts.commands.run_benchmark", "run the paper's 81 scenarios: success by method, with intervals"),
    "tune": (
        "scripts.commands.run_tune",
        "fit the ranking to logged episodes, against the manual values",
    ),
    "oracle": (
        "scripts.commands.find_reachable_grasps",
        "search each scenario for a feasible grasp, on the ground truth",
    ),
    "hal": ("scripts.commands.run_hal", "serve the arm and the camera, with servo loop, limits and watchdog"),
    "calibrate": (
        "scripts.calibrate.calibrate",
        "calibrate the wrist camera with a printed board: hand-eye, intrinsics, touch test",
    ),
    "twin": (
        "scripts.commands.run_twin",
        "use the twin in place of a device: run-script for pyrealsense2, wire for a Z1's clients",
    ),
    "stop": ("scripts.commands.stop_arm", "stop the arm now; the stop latches until rearm"),
    "rearm": ("scripts.commands.rearm_arm", "lift the latched stop, after inspecting the arm"),
    "keys": ("scripts.keys.manage_keys", "make the keys of a link beyond this machine: certificates with roles"),
    "release-arm": ("scripts.arm.release_arm", "let go of an arm that is held after its HAL has ended"),
    "doctor": ("scripts.commands.doctor", "check this machine, and show the fix of each failed check"),
    "show-config": ("scripts.commands.show_config", "print every setting in force and its origin"),
    "docs": ("scripts.commands.serve_docs", "serve the documentation"),
    "test": ("scripts.commands.run_tests", "run the tests; pytest's options may follow"),
    "check": ("scripts.commands.check_code", "lint, format, types and vocabulary, as in CI"),
}
"""Name to (module, help). A module holds `main(config) -> int` and, as `Config`, the dataclass of its options; a module
without `Config` takes the bare arguments: `main(list[str]) -> int`."""

FAILED = 1
"""Exit code of a command that failed: the arm did not follow, the object was not lifted, a check found a defect."""
BAD_USAGE = 2
"""Exit code of an input that cannot be used: an option, a configuration file, an output that exists (`UsageError`)."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it: 128 + SIGINT."""


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code: 0, `FAILED`, `BAD_USAGE` or `INTERRUPTED`."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or [""]
    if name in ("", "-h", "--help", "help"):
        print(_usage())
        return 0 if name else BAD_USAGE
    if name in ("-V", "--version"):
        from importlib.metadata import version  # 50 ms, which `stop` must not wait for

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
    except BrokenPipeError:  # `./z1 doctor | head` closes its end, which is no error
        # Python flushes at exit, which would raise the error again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        expected = isinstance(error, Z1Error | OSError)  # the project's or the file system's; others are defects
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
    import difflib

    near = difflib.get_close_matches(name, COMMANDS, n=1)
    guess = f" Did you mean `{near[0]}`?" if near else ""
    return f"there is no command {name!r}.{guess} Known: {', '.join(COMMANDS)}."


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name:<{width}}  {help_}" for name, (_, help_) in COMMANDS.items())
    return f"""usage: ./z1 COMMAND [options]

Grasping with a Unitree Z1 and a wrist camera, or with their digital twin.

{lines}

  ./z1 COMMAND --help   the options of a command
  ./z1 --version        the version

Exit codes: 0 done, 1 failed, 2 bad usage or configuration, 130 interrupted. Z1_DEBUG=1 shows tracebacks."""


if __name__ == "__main__":
    sys.exit(main())

"""A generator in a process and a Python of its own: `python -I worker.py graspgen CHECKPOINT`.

Run as a file, in an environment that has NumPy and the generator's package and need not have ours: of this project
only `models` and `hal` are made importable, from where this file lies. Answers on stdout until stdin ends.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_OLDEST = (3, 11)


def main(name: str, checkpoint: str) -> int:
    """Load the generator called `name`, say so, and answer requests; 0 when stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks; its end ends this one
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever the generator prints shall not be taken for an answer
    _import_rooms()
    from models.nvidia.nvidia import load_here
    from models.nvidia.wire import PROTOCOL, write_message

    try:
        generator = load_here(name, Path(checkpoint))
    except Exception as err:
        write_message(answers, {"error": str(err), "kind": type(err).__name__})
        return 1
    write_message(answers, {"protocol": PROTOCOL, "python": sys.version.split()[0]})
    _serve(generator, answers)
    return 0


def _serve(generator, answers) -> None:
    from models.nvidia.wire import read_message, write_message

    while (request := read_message(sys.stdin.buffer)) is not None:
        try:
            grasps = generator.sample(request["points"], int(request["n"]), int(request["seed"]))
        except Exception as err:
            write_message(answers, {"error": str(err), "kind": type(err).__name__})
        else:
            write_message(
                answers,
                {
                    "T_camera_grasps": grasps.T_camera_grasps,
                    "scores": grasps.scores,
                    "widths_m": grasps.widths_m,
                    "source": grasps.source,
                },
            )


def _import_rooms() -> None:
    """Make `models`, and `hal` for its errors, importable: our packages must not stand in for those of this Python."""
    for room in ("models", "hal"):
        folder = _ROOT / room
        spec = importlib.util.spec_from_file_location(
            room, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec is not None and spec.loader is not None
        sys.modules[room] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)


if __name__ == "__main__":
    if sys.version_info < _OLDEST:
        sys.exit(f"Python {sys.version.split()[0]} is too old; a generator's own process needs 3.11 or later.")
    sys.exit(main(*sys.argv[1:]))

"""Generator in a process and a Python of its own: `python -I worker.py graspgen CHECKPOINT`.

It runs as a file, in an environment with NumPy and the generator's package, without this project's dependencies: only
`models` and `hal.base.errors` become importable, from this file's folder. It replies on stdout until stdin ends.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
# The project's own minimum, since its modules are imported here
_OLDEST = (3, 11)


def main(name: str, checkpoint: str) -> int:
    """Load the generator called `name`, report it, and serve requests; return 0 when stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process, whose end ends this one
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # prints of the generator must not mix with the replies
    _import_packages()
    from models.nvidia.nvidia import load_in_process
    from models.nvidia.pipe import PROTOCOL, write_message

    try:
        generator = load_in_process(name, Path(checkpoint))
    except Exception as err:  # every failure has to reach the parent process
        write_message(replies, _describe(err))
        return 1
    write_message(replies, {"protocol": PROTOCOL, "python": sys.version.split()[0]})
    _serve(generator, replies)
    return 0


def _serve(generator, replies) -> None:
    from models.nvidia.pipe import read_message, write_message

    while (request := read_message(sys.stdin.buffer)) is not None:
        try:
            grasps = generator.sample(request["points"], int(request["n"]), int(request["seed"]))
        except Exception as err:  # as above
            write_message(replies, _describe(err))
        else:
            write_message(
                replies,
                {
                    "T_camera_grasps": grasps.T_camera_grasps,
                    "scores": grasps.scores,
                    "widths_m": grasps.widths_m,
                    "source": grasps.source,
                },
            )


def _describe(err: Exception) -> dict[str, str]:
    """Return an error as a message: text, kind (`ValueError` for the cloud's) and code."""
    kind = "ValueError" if isinstance(err, ValueError) else type(err).__name__
    return {"error": str(err), "kind": kind, "code": getattr(err, "code", "generator")}


def _import_packages() -> None:
    """Make `models`, and `hal` for its errors, importable without a path that would shadow this Python's packages."""
    for package in ("models", "hal"):
        folder = _ROOT / package
        spec = importlib.util.spec_from_file_location(
            package, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec is not None and spec.loader is not None
        sys.modules[package] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)


if __name__ == "__main__":
    if sys.version_info < _OLDEST:
        sys.exit(f"Python {sys.version.split()[0]} is too old; a generator's own process needs 3.11 or later.")
    sys.exit(main(*sys.argv[1:]))

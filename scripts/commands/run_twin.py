"""The digital twin in place of a device, for programs written for the device.

    ./z1 twin run-script [options] FILE.py [its own arguments]    a script for pyrealsense2 uses the twin's D405, one
                                                                  for unitree_arm_interface the twin's Z1
    ./z1 twin wire [options]                                      the twin's Z1 in place of `z1_ctrl`, or of the arm's
                                                                  motor board (or: twin --wire)

`./z1 twin run-script --help` and `./z1 twin wire --help` list the options.
"""

from __future__ import annotations

import sys
from importlib import import_module

_STEPS = {"run-script": "scripts.commands.run_script", "wire": "scripts.commands.run_wire"}
_BAD_USAGE = 2  # as `scripts.cli.BAD_USAGE`


def main(arguments: list[str]) -> int:
    """Run the step named by the first argument."""
    name, *rest = arguments or [""]
    name = "wire" if name == "--wire" else name
    if name in _STEPS:
        return import_module(_STEPS[name]).main(rest)
    if name in ("-h", "--help"):
        print(__doc__)
        return 0
    print(f"error: ./z1 twin takes one of: {', '.join(_STEPS)}; not {name!r}.", file=sys.stderr)
    return _BAD_USAGE

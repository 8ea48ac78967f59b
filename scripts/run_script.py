"""Run a script written for pyrealsense2, unmodified, on the twin's D405.

    ./z1 twin run-script --object box --frames 100 viewer.py --its-own options

In the script `import pyrealsense2` gives librealsense with the twin for a camera. The scene stands still. Windows that
OpenCV cannot open here are written to files when the script ends.
"""

from __future__ import annotations

import runpy
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from hal.clock import Clock, WallClock
from scripts.script_windows import windows_as_files


@dataclass(frozen=True, kw_only=True)
class Config:
    """What the camera looks at, and how."""

    file: tyro.conf.Positional[Path]
    """The script; what stands behind it is handed to it."""
    object: str = "bottle"
    """What stands on the table: bottle, box or cylinder."""
    distance_m: float = 0.48
    """How far in front of the base [m]."""
    lateral_m: float = 0.0
    """How far to the left [m]."""
    pitch_deg: float = 0.0
    """Lean about the base's y axis [°]."""
    seed: int = 0
    """Of the camera's noise."""
    lockstep: bool = False
    """Frames are made when the script waits for them, the same ones every time; else at their rate, by the wall."""
    frames: int = 0
    """After so many pictures shown, waitKey() answers Esc and q in turn; 0 = never."""
    windows: Path = Path("out/run-script")
    """Where the pictures of its windows go."""


def main(arguments: list[str]) -> int:
    """Run the script and return its exit code."""
    end = next((i for i, argument in enumerate(arguments, start=1) if argument.endswith(".py")), len(arguments))
    config = tyro.cli(Config, prog="z1 twin run-script", description=__doc__, args=arguments[:end])
    if not config.file.is_file():
        raise ValueError(f"there is no script {config.file}.")
    import hal.realsense as rs
    from sim_twin.clock import TwinClock
    from sim_twin.realsense_source import TwinSource
    from sim_twin.scene import SceneConfig
    from sim_twin.world import World

    scene = SceneConfig(
        object=config.object,
        distance_m=config.distance_m,
        lateral_m=config.lateral_m,
        pitch_deg=config.pitch_deg,
        seed=config.seed,
    )
    world = World(scene)
    clock: Clock = TwinClock(world) if config.lockstep else WallClock()
    with TwinSource(world, clock) as source, windows_as_files(config.windows, clock, config.frames):
        source.warm_up()
        with rs.plugged(source), rs.masquerade():
            return run_program(config.file, arguments[end:])


def run_program(file: Path, arguments: list[str]) -> int:
    """Run a script as Python would run it, in this process, and return its exit code."""
    sys.argv = [str(file), *arguments]
    sys.path.insert(0, str(file.resolve().parent))
    try:
        runpy.run_path(str(file), run_name="__main__")
    except SystemExit as ended:
        if ended.code is None or isinstance(ended.code, int):
            return ended.code or 0
        print(ended.code, file=sys.stderr)
        return 1
    return 0

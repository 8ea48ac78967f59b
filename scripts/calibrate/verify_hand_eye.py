"""Touch test of a hand-eye calibration: the tip of the closed jaws is sent over corners of the board.

    ./z1 calibrate verify                     the twin, which knows by how much each corner is missed
    ./z1 calibrate verify --hal real          at each corner, measure and type the offset

On the real arm, read from the print how far the tip is from the corner: to the right and down as the board is read.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from calibration.board.board import Board
from scripts.calibrate.calibration_samples import now
from scripts.support.calibration_robot import CalibrationRobot, RobotOptions, open_robot

if TYPE_CHECKING:
    from z1_runtime.calibration_session.tip_check import Touch

Ask = Callable[[str], str]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which calibration, robot and board."""

    calibration: Path | None = None
    """A hand-eye result; by default the newest of this camera, else the mount's drawing."""
    calibrations: Path | None = None
    """Folder of results; by default $Z1_CALIBRATIONS, else z1-grasp/calibrations of the user's data."""
    corners: int = 5
    """How many corners."""
    height_m: float = 0.003
    """How far over the print the tip stops [m]."""
    speed: float = 0.25
    """Fraction of the arm's limits that motions use."""
    tolerance_m: float = 0.002
    """The test is passed when no corner is missed by more [m]."""
    out: Path = Path("out/touch_test.json")
    """What was measured."""
    seed: int = 0
    """Of the twin's noise."""
    board: Annotated[Board, tyro.conf.arg(name="")] = field(default_factory=Board)
    """The board that lies there."""
    robot: Annotated[RobotOptions, tyro.conf.arg(name="")] = field(default_factory=RobotOptions)
    """Which robot."""


def main(config: Config, ask: Ask = input) -> int:
    """Point at corners; 0 when all are within the tolerance."""
    from z1_runtime.calibration_session.board_search import BoardSearch
    from z1_runtime.calibration_session.tip_check import TouchConfig, TouchTest
    from z1_runtime.perception.extrinsics import find_extrinsics

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    touch_config = TouchConfig(n=config.corners, height_m=config.height_m, speed=config.speed)
    with ExitStack() as undo:
        robot = undo.enter_context(open_robot(config.robot, config.board, config.seed))
        mount = find_extrinsics(robot.camera.wait_for_frame(5.0).serial, config.calibration, config.calibrations)
        console.print(f"camera: {mount.origin}", soft_wrap=True)
        robot.arm.claim("verify")
        search = BoardSearch(
            arm=robot.arm,
            camera=robot.camera,
            clock=robot.clock,
            board=config.board,
            T_flange_camera=mount.T_flange_camera,
            speed=config.speed,
        )
        found = search.look_closer(search.find())
        test = TouchTest(robot.arm, robot.clock, config.board, touch_config)
        rows = []
        for touch in test.run(found.T_base_board, found.checker):
            if touch.problem:
                console.print(f"corner {touch.corner} is left out: {touch.problem}")
            elif (offset_mm := _offset_mm(touch, config, robot, ask)) is not None:
                rows.append({"corner": touch.corner, "offset_mm": offset_mm.round(4).tolist()})
        search.go_home(found.checker)
    return _report(rows, mount.origin, config, console)


def _offset_mm(touch: Touch, config: Config, robot: CalibrationRobot, ask: Ask) -> np.ndarray | None:
    """Return how far the tip is from where it should be, right, down and too high as the board is read, (3,) [mm].

    The twin knows; of a real arm somebody types the first two, or nothing to leave the corner out.
    """
    if robot.truth is not None:
        T_base_board = robot.truth().T_base_board
        assert T_base_board is not None
        p_board_tip = T_base_board[:3, :3].T @ (touch.p_base_tip - T_base_board[:3, 3])
        offset = p_board_tip - config.board.corners_m[touch.corner]
        return 1e3 * np.array([offset[0], offset[1], -offset[2] - config.height_m])
    while answer := ask(f"corner {touch.corner}: how far is the tip to its right and below it [mm], like 0.5 -1 ? "):
        try:
            right, down = (float(number) for number in answer.replace(",", " ").split())
        except ValueError:
            continue
        return np.array([right, down, 0.0])
    return None


def _report(rows: list[dict[str, Any]], origin: str, config: Config, console: Console) -> int:
    """Print and keep what was measured; 0 when it is within the tolerance."""
    if not rows:
        console.print("[red]no corner was measured[/]")
        return 1
    offsets_mm = np.array([row["offset_mm"] for row in rows])
    missed_mm = np.linalg.norm(offsets_mm, axis=1)
    table = Table("corner", "right [mm]", "down [mm]", "too high [mm]", "missed by [mm]", title="touch test")
    for row, offset, missed in zip(rows, offsets_mm, missed_mm, strict=True):
        table.add_row(str(row["corner"]), *(f"{value:+.2f}" for value in offset), f"{missed:.2f}")
    console.print(table)
    passed = bool(missed_mm.max() <= 1e3 * config.tolerance_m)
    summary = {
        "date": now(),
        "calibration": origin,
        "passed": passed,
        "mean_mm": round(float(missed_mm.mean()), 4),
        "max_mm": round(float(missed_mm.max()), 4),
        "tolerance_mm": 1e3 * config.tolerance_m,
        "corners": rows,
    }
    config.out.parent.mkdir(parents=True, exist_ok=True)
    config.out.write_text(json.dumps(summary, indent=2) + "\n")
    verdict = "[bold green]passed[/]" if passed else "[bold red]not passed[/]: calibrate again"
    console.print(
        f"{verdict}; missed by {missed_mm.mean():.2f} mm on average, {missed_mm.max():.2f} mm at most (allowed "
        f"{1e3 * config.tolerance_m:g} mm); {config.out}",
        soft_wrap=True,
    )
    return 0 if passed else 1


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))

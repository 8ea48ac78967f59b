"""Check a hand-eye calibration: the tip of the closed jaws moves over corners of the board.

    ./z1 calibrate verify                     the twin, with the offsets by its ground truth
    ./z1 calibrate verify --hal real          at each corner, measure and type the offset

On the real arm, measure on the print the offset of the tip from the corner: to the right and down as the board is read.
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
from hal.base.files import atomic_write
from hal.base.output_folder import check_output_file
from hal.base.transforms import inverse, transform_points
from scripts.calibrate.calibration_samples import now
from scripts.support.calibration_robot import CalibrationRobot, RobotOptions, open_robot

if TYPE_CHECKING:
    from z1_runtime.calibration_session.tip_check import TipMeasurement

Ask = Callable[[str], str]


@dataclass(frozen=True, kw_only=True)
class Config:
    """Calibration, robot and board."""

    calibration: Path | None = None
    """A hand-eye result; by default the newest of this camera, else the nominal extrinsics."""
    calibrations: Path | None = None
    """Folder of results; by default $Z1_CALIBRATIONS, else z1-grasp/calibrations of the user's data."""
    corners: int = 5
    """Number of corners."""
    height_m: float = 0.003
    """Height of the tip above the print [m]."""
    speed: float = 0.25
    """Fraction of the arm's limits that motions use."""
    tolerance_m: float = 0.002
    """Maximum offset at any corner for the check to pass [m]."""
    out: Path = Path("out/tip_check.json")
    """Measured offsets."""
    seed: int = 0
    """Seed of the twin's noise."""
    board: Annotated[Board, tyro.conf.arg(name="")] = field(default_factory=Board)
    """The board on the table."""
    robot: Annotated[RobotOptions, tyro.conf.arg(name="")] = field(default_factory=RobotOptions)
    """The robot."""


def main(config: Config, ask: Ask = input) -> int:
    """Move over corners; return 0 when all offsets are within the tolerance."""
    from z1_runtime.calibration_session.board_search import BoardSearch
    from z1_runtime.calibration_session.tip_check import TipCheck, TipCheckConfig
    from z1_runtime.perception.extrinsics import find_extrinsics

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    check_config = TipCheckConfig(n=config.corners, height_m=config.height_m, speed=config.speed)
    with ExitStack() as undo:
        robot = undo.enter_context(open_robot(config.robot, config.board, config.seed))
        # A frame has the serial number by which its calibration is found.
        extrinsics = find_extrinsics(robot.camera.wait_for_frame(5.0).serial, config.calibration, config.calibrations)
        console.print(f"camera: {extrinsics.origin}", soft_wrap=True)
        robot.arm.claim("verify")
        search = BoardSearch(
            arm=robot.arm,
            camera=robot.camera,
            clock=robot.clock,
            board=config.board,
            T_flange_camera=extrinsics.T_flange_camera,
            speed=config.speed,
        )
        found = search.refine(search.find())
        check = TipCheck(robot.arm, robot.clock, config.board, check_config)
        rows = []
        for measurement in check.run(found.T_base_board, found.checker):
            if measurement.failure:
                console.print(f"corner {measurement.corner} is left out: {measurement.failure}")
            elif (offset_mm := _offset_mm(measurement, config, robot, ask)) is not None:
                rows.append({"corner": measurement.corner, "offset_mm": offset_mm.round(4).tolist()})
        search.move_home(found.checker)
    return _report(rows, extrinsics.origin, config, console)


def _offset_mm(measurement: TipMeasurement, config: Config, robot: CalibrationRobot, ask: Ask) -> np.ndarray | None:
    """Return the offset (3,) of the tip from its target: right, down and too high as the board is read [mm].

    The twin's is from its ground truth; of a real arm the operator types the first two, or nothing to skip the corner.
    """
    if robot.ground_truth is not None:
        T_base_board = robot.ground_truth().T_base_board
        assert T_base_board is not None
        p_board_tip = transform_points(inverse(T_base_board), measurement.p_base_tip)
        offset = p_board_tip - config.board.corners_m[measurement.corner]
        # The board's z axis points into it: a tip above the print is at a negative z.
        return 1e3 * np.array([offset[0], offset[1], -offset[2] - config.height_m])
    while answer := ask(f"corner {measurement.corner}: offset of the tip to the right and down [mm], like 0.5 -1 ? "):
        try:
            right, down = (float(number) for number in answer.replace(",", " ").split())
        except ValueError:
            continue
        return np.array([right, down, 0.0])
    return None


def _report(rows: list[dict[str, Any]], origin: str, config: Config, console: Console) -> int:
    """Print and save the offsets; return 0 when they are within the tolerance."""
    if not rows:
        console.print("[red]no corner was measured[/]")
        return 1
    offsets_mm = np.array([row["offset_mm"] for row in rows])
    distances_mm = np.linalg.norm(offsets_mm, axis=1)
    table = Table("corner", "right [mm]", "down [mm]", "too high [mm]", "offset [mm]", title="tip check")
    for row, offset, distance in zip(rows, offsets_mm, distances_mm, strict=True):
        table.add_row(str(row["corner"]), *(f"{value:+.2f}" for value in offset), f"{distance:.2f}")
    console.print(table)
    passed = bool(distances_mm.max() <= 1e3 * config.tolerance_m)
    summary = {
        "date": now(),
        "calibration": origin,
        "passed": passed,
        "mean_mm": round(float(distances_mm.mean()), 4),
        "max_mm": round(float(distances_mm.max()), 4),
        "tolerance_mm": 1e3 * config.tolerance_m,
        "corners": rows,
    }
    atomic_write(check_output_file(config.out), json.dumps(summary, indent=2) + "\n")
    verdict = "[bold green]passed[/]" if passed else "[bold red]not passed[/]: calibrate again"
    console.print(
        f"{verdict}; mean offset {distances_mm.mean():.2f} mm, maximum {distances_mm.max():.2f} mm (allowed "
        f"{1e3 * config.tolerance_m:g} mm); {config.out}",
        soft_wrap=True,
    )
    return 0 if passed else 1


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))

"""Capture images of the calibration board from many sides; each is saved at once.

./z1 calibrate capture                          the twin
./z1 calibrate capture --hal real               the arm of a running HAL; place the board 0.4 m in front of it
./z1 calibrate capture --hal real --hand-guided the same with the arm guided by hand; Enter captures, q ends
./z1 calibrate capture --out DIR                continue an interrupted capture
"""

from __future__ import annotations

import logging
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from calibration.board.board import Board
from hal.base.errors import InvalidValueError
from scripts.calibrate.calibration_samples import now
from scripts.support.calibration_robot import RobotOptions, open_robot

if TYPE_CHECKING:
    from sim_twin.ground_truth import GroundTruth
    from z1_runtime.calibration_session.capture import CapturedView, Key, SampleCapture


@dataclass(frozen=True, kw_only=True)
class Config:
    """Robot, board and number of samples."""

    out: Path | None = None
    """Folder of the samples; by default a new one in the folder of results. A folder with samples is completed."""
    poses: int = 20
    """Number of samples."""
    hand_guided: bool = False
    """Do not move the arm: capture when Enter is pressed, or when the arm rests at a new view."""
    speed: float = 0.5
    """Fraction of the arm's limits that motions use."""
    seed: int = 0
    """Seed of the views, and of the twin's noise."""
    view: bool = False
    """Show the capture live in Rerun."""
    board: Annotated[Board, tyro.conf.arg(name="")] = field(default_factory=Board)
    """The board on the table."""
    robot: Annotated[RobotOptions, tyro.conf.arg(name="")] = field(default_factory=RobotOptions)
    """The robot."""


def main(config: Config) -> int:
    """Capture; return 0 with the wanted number of samples."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    folder, n = capture(config, console)
    console.print(f"solve them with `./z1 calibrate hand-eye --samples {folder}`", soft_wrap=True)
    return 0 if n >= config.poses else 1


def capture(config: Config, console: Console, read_key: Callable[[], Key] | None = None) -> tuple[Path, int]:
    """Fill a folder with samples and return it with their number.

    Args:
        config: options of the capture.
        console: for the progress.
        read_key: returns the operator's key while the arm is guided by hand; by default from the terminal.
    """
    from z1_runtime.calibration_session.board_search import BoardSearch
    from z1_runtime.calibration_session.capture import SampleCapture
    from z1_runtime.visualization.rerun_logger import RerunLogger

    if config.poses < 1 or not 0.0 < config.speed <= 1.0:
        raise InvalidValueError(
            f"capture: out of range (poses {config.poses}, speed {config.speed}; allowed from 1, above 0 to 1)."
        )
    folder = config.out or new_folder()
    with ExitStack() as undo:
        inspector = RerunLogger(folder / "capture.rrd" if config.view else None, live=config.view)
        undo.callback(inspector.close)
        robot = undo.enter_context(open_robot(config.robot, config.board, config.seed))
        devices = {"arm": robot.arm, "camera": robot.camera, "clock": robot.clock, "board": config.board}
        session = SampleCapture(**devices, folder=folder, inspector=inspector)
        n_before = session.open(now(), twin_ground_truth(robot.ground_truth))
        console.print(
            f"samples go to {folder}" + (f", which has {n_before} already" if n_before else ""), soft_wrap=True
        )
        if config.hand_guided:
            console.print("guide the arm by hand: rest for a sample, Enter captures one at once, q Enter ends")
            views = session.capture_hand_guided(read_key or read_terminal_key, config.poses)
        else:
            robot.arm.claim("calibrate")
            search = BoardSearch(**devices, speed=config.speed)
            search.executor.watchers.append(inspector.log_arm)
            views = session.capture_automatically(search, config.poses, config.seed)
        try:
            _report_progress(session, views, config.poses, console)
        except KeyboardInterrupt:
            n = len(session.captured)
            console.print(
                f"{n} of {config.poses} samples are kept; `--out {folder}` goes on from there", soft_wrap=True
            )
            raise  # so that the command ends with the exit code of Ctrl-C
    return folder, len(session.captured)


def capture_next_to_results(calibrations: Path | None, config: Config, console: Console) -> Path:
    """Capture as `capture` does, into a new folder of the results in `calibrations` unless `config` names one."""
    return capture(replace(config, out=config.out or new_folder(calibrations)), console)[0]


def new_folder(calibrations: Path | None = None) -> Path:
    """Return a new folder for samples in the folder of results `calibrations`."""
    from z1_runtime.perception.extrinsics import results_folder

    return results_folder(calibrations) / "samples" / datetime.now().strftime("%Y-%m-%dT%H-%M-%S")


def read_terminal_key() -> Key:
    """Return the key typed since the last call, without waiting."""
    if not select.select([sys.stdin], [], [], 0.0)[0]:
        return ""
    line = sys.stdin.readline()
    # Nothing, not even a newline: the input has ended.
    return "end" if not line or line.strip().lower().startswith("q") else "take"


def twin_ground_truth(ground_truth: Callable[[], GroundTruth] | None) -> dict | None:
    """Return the twin's poses as saved with the samples; None for a real arm."""
    if ground_truth is None:
        return None
    poses = ground_truth()
    assert poses.T_base_board is not None  # the scene was made with a board
    return {"T_mount_camera": poses.T_flange_camera.tolist(), "T_anchor_board": poses.T_base_board.tolist()}


def _report_progress(session: SampleCapture, views: Iterator[CapturedView], n_samples: int, console: Console) -> None:
    from z1_runtime.calibration_session.coverage import Coverage

    coverage = Coverage.of(session.captured)
    try:
        for captured in views:
            if captured.view is None:
                console.print(f"  {'–':>9}  {captured.message}", soft_wrap=True)
                continue
            coverage = Coverage.of(session.captured)
            warning = f"  {captured.message}" if captured.message else ""
            console.print(
                f"  {len(session.captured):>3} of {n_samples:<3} {captured.name}  {len(captured.view.ids):>3} corners; "
                f"so far {coverage.summary()}{warning}",
                soft_wrap=True,
            )
    finally:  # also after Ctrl-C
        console.print(coverage.draw_map())


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))

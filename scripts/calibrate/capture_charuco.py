"""Take pictures of the calibration board from many sides; each is on disk as it is taken.

./z1 calibrate capture                          the twin
./z1 calibrate capture --hal real               the arm whose HAL runs; lay the board 0.4 m in front of it first
./z1 calibrate capture --hal real --hand-guided the same while a hand guides the arm; Enter takes a picture, q ends
./z1 calibrate capture --out DIR                goes on where an interrupted capture stopped
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
    from z1_runtime.calibration_session.capture import Capture, Key, Taken


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which robot and board, and how many pictures."""

    out: Path | None = None
    """Folder of the samples; by default a new one beside the results. One that holds samples is completed."""
    poses: int = 20
    """How many pictures."""
    hand_guided: bool = False
    """Do not move the arm: take a picture when Enter is pressed, or a new view is held still."""
    speed: float = 0.5
    """Fraction of the arm's limits that motions use."""
    seed: int = 0
    """Of the views, and of the twin's noise."""
    view: bool = False
    """Show everything live in Rerun."""
    board: Annotated[Board, tyro.conf.arg(name="")] = field(default_factory=Board)
    """The board that lies there."""
    robot: Annotated[RobotOptions, tyro.conf.arg(name="")] = field(default_factory=RobotOptions)
    """Which robot."""


def main(config: Config) -> int:
    """Capture; 0 when there are as many pictures as wanted."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    console = Console(highlight=False)
    folder, n = capture(config, console)
    console.print(f"solve them with `./z1 calibrate hand-eye --samples {folder}`", soft_wrap=True)
    return 0 if n >= config.poses else 1


def capture(config: Config, console: Console, pressed: Callable[[], Key] | None = None) -> tuple[Path, int]:
    """Fill a folder with samples and return it with their number.

    Args:
        config: how.
        console: where progress is told.
        pressed: asked for the operator's key while a hand guides the arm; by default the terminal is.
    """
    from z1_runtime.calibration_session.board_search import BoardSearch
    from z1_runtime.calibration_session.capture import Capture
    from z1_runtime.visualization.rerun_logger import RerunLogger

    if config.poses < 1 or not 0.0 < config.speed <= 1.0:
        raise InvalidValueError(
            f"poses is {config.poses}, speed is {config.speed}; allowed are 1 and more, above 0 up to 1."
        )
    folder = config.out or new_folder()
    with ExitStack() as undo:
        inspector = RerunLogger(folder / "capture.rrd" if config.view else None, live=config.view)
        undo.callback(inspector.close)
        robot = undo.enter_context(open_robot(config.robot, config.board, config.seed))
        devices = {"arm": robot.arm, "camera": robot.camera, "clock": robot.clock, "board": config.board}
        session = Capture(**devices, folder=folder, inspector=inspector)
        n_before = session.open(now(), twin_truth(robot.truth))
        console.print(
            f"samples go to {folder}" + (f", which has {n_before} already" if n_before else ""), soft_wrap=True
        )
        if config.hand_guided:
            console.print("guide the arm by hand: hold still for a picture, Enter takes one at once, q Enter ends")
            pictures = session.follow_hand(pressed or terminal_key, config.poses)
        else:
            robot.arm.claim("calibrate")
            search = BoardSearch(**devices, speed=config.speed)
            search.executor.watchers.append(inspector.log_arm)
            pictures = session.drive(search, config.poses, config.seed)
        try:
            _tell(session, pictures, config.poses, console)
        except KeyboardInterrupt:
            n = len(session.taken)
            console.print(
                f"{n} of {config.poses} samples are kept; `--out {folder}` goes on from there", soft_wrap=True
            )
            raise
    return folder, len(session.taken)


def capture_beside(calibrations: Path | None, config: Config, console: Console) -> Path:
    """As `capture`, into a folder beside the results in `calibrations` unless `config` names one."""
    return capture(replace(config, out=config.out or new_folder(calibrations)), console)[0]


def new_folder(calibrations: Path | None = None) -> Path:
    """Return a folder for samples beside the results in `calibrations` that does not exist yet."""
    from z1_runtime.perception.extrinsics import results_folder

    return results_folder(calibrations) / "samples" / datetime.now().strftime("%Y-%m-%dT%H-%M-%S")


def terminal_key() -> Key:
    """Return what was typed since the last call, without waiting."""
    if not select.select([sys.stdin], [], [], 0.0)[0]:
        return ""
    line = sys.stdin.readline()
    return "end" if not line or line.strip().lower().startswith("q") else "take"


def twin_truth(truth: Callable[[], GroundTruth] | None) -> dict | None:
    """Return what a session keeps of the twin's truth; None where nobody knows it."""
    if truth is None:
        return None
    poses = truth()
    assert poses.T_base_board is not None
    return {"T_mount_camera": poses.T_flange_camera.tolist(), "T_anchor_board": poses.T_base_board.tolist()}


def _tell(session: Capture, pictures: Iterator[Taken], wanted: int, console: Console) -> None:
    from z1_runtime.calibration_session.coverage import Coverage

    coverage = Coverage.of(session.taken)
    try:
        for taken in pictures:
            if taken.view is None:
                console.print(f"  {'–':>9}  {taken.problem}", soft_wrap=True)
                continue
            coverage = Coverage.of(session.taken)
            doubt = f"  {taken.problem}" if taken.problem else ""
            console.print(
                f"  {len(session.taken):>3} of {wanted:<3} {taken.name}  {len(taken.view.ids):>3} corners; so far "
                f"{coverage.summary()}{doubt}",
                soft_wrap=True,
            )
    finally:  # also after Ctrl-C
        console.print(coverage.picture())


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Config)))

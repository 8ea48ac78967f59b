"""The robot that a calibration drives: the twin in this process, or whatever a HAL process serves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from calibration.board.board import Board
from hal.base.arm import ServoedArm
from hal.base.camera import Camera
from hal.base.clock import Clock, WallClock
from hal.base.errors import HalTimeoutError
from hal.bus.session import BusConfig

if TYPE_CHECKING:
    from sim_twin.ground_truth import GroundTruth
    from sim_twin.model.charuco_board import BoardSpec
    from sim_twin.model.scene import SceneConfig

PIXELS_PER_SQUARE = 100
"""Of the twin's print: 0.25 mm on the default board, finer than a pixel of the camera at any distance."""


@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """Which robot, and for the twin how it is built."""

    hal: Literal["sim", "real"] = "sim"
    """`sim`: the twin with a board on its table, in this process and on its own clock, so that the same seed gives the
    same figures. `real`: the robot whose HAL runs already (`./z1 hal`)."""
    board_x_m: float = 0.42
    """Twin: middle of the board in front of the base [m]."""
    board_y_m: float = 0.0
    """Twin: the same to the left [m]."""
    board_yaw_deg: float = 0.0
    """Twin: how the board is turned [°]."""
    mount_error_m: float = 0.0
    """Twin: how far the camera really sits from where the mount's drawing has it [m]."""
    mount_error_deg: float = 0.0
    """Twin: how far it is really turned [°]."""
    mount_seed: int = 0
    """Twin: of the direction of both."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Where the HAL process listens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRobot:
    """A connected robot."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    truth: Callable[[], GroundTruth] | None
    """Where everything really is; None where nobody knows."""


@contextmanager
def open_robot(options: RobotOptions, board: Board, seed: int) -> Iterator[CalibrationRobot]:
    """Yield the robot; its lease is not claimed yet.

    Args:
        options: which.
        board: what lies on the twin's table.
        seed: of the twin's noise.

    Raises:
        HalTimeoutError: no HAL process answers.
        ValueError: the twin cannot be built like that.
    """
    if options.hal == "sim":
        from scripts.support.demo_robot import lockstep_robot

        with lockstep_robot(make_scene(options, board, seed)) as robot:
            yield CalibrationRobot(arm=robot.arm, camera=robot.camera, clock=robot.clock, truth=robot.truth)
        return
    with ExitStack() as undo:
        yield _served_robot(options.bus, undo)


def _served_robot(bus: BusConfig, undo: ExitStack) -> CalibrationRobot:
    from hal.bus.client import RemoteArm, RemoteCamera

    clock = WallClock()
    arm = undo.enter_context(RemoteArm(bus, "calibrate", clock))
    camera = RemoteCamera(bus, clock)
    camera.connect()
    undo.callback(camera.disconnect)
    return CalibrationRobot(arm=arm, camera=camera, clock=clock, truth=_served_truth(bus, undo))


def _served_truth(bus: BusConfig, undo: ExitStack) -> Callable[[], GroundTruth] | None:
    """Return the truth if the HAL is a twin's with a board on its table."""
    from sim_twin.ground_truth import GroundTruthClient

    client = undo.enter_context(GroundTruthClient(bus))
    try:
        return client.read if client.read().T_base_board is not None else None
    except HalTimeoutError:
        return None


def make_scene(options: RobotOptions, board: Board, seed: int) -> SceneConfig:
    """Return the twin's scene with `board` on the table."""
    from sim_twin.model.scene import SceneConfig

    return SceneConfig(
        seed=seed,
        board=make_print(options, board),
        mount_error_m=options.mount_error_m,
        mount_error_deg=options.mount_error_deg,
        mount_seed=options.mount_seed,
    )


def make_print(options: RobotOptions, board: Board) -> BoardSpec:
    """Return `board` as the twin takes it."""
    from sim_twin.model.charuco_board import BoardSpec

    return BoardSpec(
        image=board.image(PIXELS_PER_SQUARE),
        size_m=board.size_m,
        x_m=options.board_x_m,
        y_m=options.board_y_m,
        yaw_deg=options.board_yaw_deg,
    )

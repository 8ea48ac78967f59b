"""The robot of a calibration: the twin in this process, or the devices of a HAL process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from calibration.board.board import Board
from hal.base.arm import ServoedArm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.base.errors import HalTimeoutError
from hal.bus.session import BusConfig
from hal.rig import connect_remote, connect_rig
from scripts.support.scene_options import MountErrorOptions

if TYPE_CHECKING:
    from sim_twin.ground_truth import GroundTruth
    from sim_twin.model.charuco_board import BoardSpec
    from sim_twin.model.scene import SceneConfig

PIXELS_PER_SQUARE = 100
"""Resolution of the twin's print: 0.25 mm on the default board, finer than a pixel of the camera at any distance."""


@dataclass(frozen=True, kw_only=True)
class RobotOptions(MountErrorOptions):
    """Selection of the robot, and the twin's set-up."""

    devices: Annotated[Literal["sim", "remote", "real"], tyro.conf.arg(aliases=["--hal"])] = "sim"
    """`sim`: the twin with a board on its table, in this process and on its own clock, so that the same seed gives the
    same figures. `remote` (also `real`): the devices of the HAL process that is running (`./z1 hal`)."""
    board_x_m: float = 0.42
    """Twin: centre of the board in front of the base [m]."""
    board_y_m: float = 0.0
    """Twin: centre of the board to the left [m]."""
    board_yaw_deg: float = 0.0
    """Twin: rotation of the board about the vertical [°]."""
    bus: Annotated[BusConfig, tyro.conf.arg(name="")] = field(default_factory=BusConfig)
    """Address of the HAL process."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRobot:
    """A connected robot."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    ground_truth: Callable[[], GroundTruth] | None
    """Ground truth of the scene; None for a real robot."""


@contextmanager
def open_robot(options: RobotOptions, board: Board, seed: int) -> Iterator[CalibrationRobot]:
    """Yield the robot; its lease is not claimed yet.

    Args:
        options: selection of the robot.
        board: on the twin's table.
        seed: of the twin's noise.

    Raises:
        HalTimeoutError: no HAL process answers.
        ValueError: the twin cannot be built like that.
    """
    with ExitStack() as stack:
        if options.devices == "sim":
            from sim_twin.backends import make_rig
            from sim_twin.ground_truth import read_ground_truth

            devices = stack.enter_context(connect_rig(make_rig(make_scene(options, board, seed), lockstep=True)))
            ground_truth: Callable[[], GroundTruth] | None = partial(read_ground_truth, devices.world)
        else:
            devices = stack.enter_context(connect_remote(options.bus, "calibrate"))
            ground_truth = _remote_ground_truth(options.bus, stack)
        yield CalibrationRobot(arm=devices.arm, camera=devices.camera, clock=devices.clock, ground_truth=ground_truth)


def _remote_ground_truth(bus: BusConfig, stack: ExitStack) -> Callable[[], GroundTruth] | None:
    """Return the ground truth if the HAL is a twin's with a board on its table."""
    from sim_twin.ground_truth import GroundTruthClient

    client = stack.enter_context(GroundTruthClient(bus))
    try:  # a real robot has no such service, and a twin may have another scene
        return client.read if client.read().T_base_board is not None else None
    except HalTimeoutError:
        return None


def make_scene(options: RobotOptions, board: Board, seed: int) -> SceneConfig:
    """Return the twin's scene with `board` on the table."""
    from sim_twin.model.scene import SceneConfig

    mount = {each.name: getattr(options, each.name) for each in fields(MountErrorOptions)}
    return SceneConfig(seed=seed, board=make_print(options, board), **mount)


def make_print(options: RobotOptions, board: Board) -> BoardSpec:
    """Return `board` in the twin's form."""
    from sim_twin.model.charuco_board import BoardSpec

    return BoardSpec(
        image=board.image(PIXELS_PER_SQUARE),
        size_m=board.size_m,
        x_m=options.board_x_m,
        y_m=options.board_y_m,
        yaw_deg=options.board_yaw_deg,
    )

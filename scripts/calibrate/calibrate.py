"""Calibrate the wrist camera with a printed ChArUco board, and check the result.

./z1 calibrate board         write the board as a page to print
./z1 calibrate hand-eye      estimate the camera's pose on the flange, with its uncertainty
./z1 calibrate verify        move the tip over corners of the board and measure the offsets
./z1 calibrate intrinsics    estimate camera matrix and distortion
./z1 calibrate capture       capture samples only, to solve later
"""

from __future__ import annotations

from types import ModuleType
from typing import Annotated, Any

import tyro

from scripts.calibrate import calibrate_hand_eye, calibrate_intrinsics, capture_charuco, make_board, verify_hand_eye


def _step(name: str, module: ModuleType) -> Any:
    """Return the annotation of a step's options; its help is the module's first sentence."""
    return tyro.conf.subcommand(name, description=(module.__doc__ or "").split("\n\n")[0])


_STEPS = (make_board, capture_charuco, calibrate_intrinsics, calibrate_hand_eye, verify_hand_eye)

Config = (
    Annotated[make_board.Config, _step("board", make_board)]
    | Annotated[capture_charuco.Config, _step("capture", capture_charuco)]
    | Annotated[calibrate_intrinsics.Config, _step("intrinsics", calibrate_intrinsics)]
    | Annotated[calibrate_hand_eye.Config, _step("hand-eye", calibrate_hand_eye)]
    | Annotated[verify_hand_eye.Config, _step("verify", verify_hand_eye)]
)
"""Options of one step."""


def main(config: object) -> int:
    """Run the step of `config`."""
    (step,) = (step for step in _STEPS if isinstance(config, step.Config))
    return step.main(config)  # pyright: ignore[reportArgumentType] - the type was matched above

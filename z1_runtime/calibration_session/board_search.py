"""Finds the board on the table with the wrist camera, and drives among the views of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.board.board import Board
from calibration.board.detection import detect_board
from calibration.board.pose import estimate_board_pose
from calibration.camera_model import CameraModel
from calibration.errors import CalibrationError
from hal.base import z1
from hal.base.arm import Arm, ServoedArm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.base.messages import Intrinsics, RgbdFrame
from hal.base.transforms import inverse, make_pose
from z1_runtime.calibration_session.viewpoints import (
    Viewpoint,
    ViewpointConfig,
    find_viewpoints,
    look_around,
    plan_way,
    table_only,
)
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.executor import Executor, MotionError
from z1_runtime.motion.trajectory import MotionLimits

STILL_RAD = 1e-3
"""An arm whose joints change less than this while a picture is taken stands still [rad]."""

_TRIES = 5
_FROM_ABOVE = make_pose(np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]), np.array([0.36, 0.0, 0.38]))
"""T_base_camera that sees what lies too near to be seen from home."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundBoard:
    """The board as the camera has seen it once."""

    T_base_board: np.ndarray
    """(4, 4) where it lies, by the mount assumed."""
    checker: CollisionChecker
    """What else was seen, to keep away from."""
    intrinsics: Intrinsics
    """Of the camera."""


class BoardSearch:
    """Drives the arm to where the board is seen; its lease is held.

    Args:
        arm: connected.
        camera: the wrist camera, connected.
        clock: the one both live by.
        board: to be found.
        T_flange_camera: (4, 4) the mount as far as it is known.
        views: from where a board may be looked at.
        speed: fraction of the arm's limits that motions use, in (0, 1].
        rest_s: how long the arm stands before a picture is taken [s].
        frame_timeout_s: how long to wait for a camera frame [s].
    """

    def __init__(
        self,
        *,
        arm: ServoedArm,
        camera: Camera,
        clock: Clock,
        board: Board,
        T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
        views: ViewpointConfig | None = None,
        speed: float = 0.5,
        rest_s: float = 0.3,
        frame_timeout_s: float = 5.0,
    ) -> None:
        self.kinematics = Kinematics()
        self.executor = Executor(arm, clock)
        self.views = views or ViewpointConfig()
        self._arm, self._camera, self._clock = arm, camera, clock
        self._board = board
        self._T_flange_camera = T_flange_camera
        self._limits = MotionLimits.at_speed(speed)
        self._rest_s, self._frame_timeout_s = rest_s, frame_timeout_s

    def find(self) -> FoundBoard:
        """Look from home and, if the board is not seen from there, from above what lies near the arm.

        Raises:
            CalibrationError: the board is not seen.
            NoTableError: nor is the table.
            MotionError, HalError: there is no free way, or the arm does not follow.
        """
        frame, q = self.still_frame()
        if not self.go(self._home(), table_only(self.kinematics, frame, q)):
            raise MotionError("there is no free way home from here; move the arm up by hand, then try again.")
        frame, q = self.still_frame()
        checker = look_around(self.kinematics, frame, q, self._T_flange_camera)
        try:
            T_base_board = self._board_in_base(frame, q)
        except CalibrationError as error:
            if error.code == "wrong_board":
                raise
            above = self.kinematics.best(_FROM_ABOVE @ inverse(self._T_flange_camera) @ z1.T_FLANGE_PIVOT)
            if self.go(np.append(above.q, self.views.jaw), checker):
                frame, q = self.still_frame()
            T_base_board = self._board_in_base(frame, q)
        return FoundBoard(T_base_board=T_base_board, checker=checker, intrinsics=frame.intrinsics)

    def look_closer(self, found: FoundBoard) -> FoundBoard:
        """Look once more, from where most of the board is seen.

        Raises:
            As `find`; and NoViewpointsError: no such place is within reach.
        """
        (view,) = self.choose(found, 1)
        if not self.go(view.q, found.checker):
            raise MotionError("there is no free way to where the board is seen best; clear the table around it.")
        frame, q = self.still_frame()
        return replace(found, T_base_board=self._board_in_base(frame, q))

    def choose(
        self, found: FoundBoard, n: int, *, taken: list[np.ndarray] | None = None, seed: int = 0
    ) -> list[Viewpoint]:
        """Return `n` views, far from each other and from those `taken` (see `find_viewpoints`)."""
        return find_viewpoints(
            self.kinematics,
            found.checker,
            found.intrinsics,
            found.T_base_board,
            self._board.corners_m,
            q_start=self._q_command(),
            T_flange_camera=self._T_flange_camera,
            taken=taken or [],
            config=replace(self.views, n=n),
            seed=seed,
        )

    def go(self, q: np.ndarray, checker: CollisionChecker) -> bool:
        """Go to `q` (7,) and come to rest; False if there is no free way.

        Raises:
            MotionError, HalError: the arm does not follow, or is stopped.
        """
        way = plan_way(checker, self._q_command(), q, self._limits)
        if way is not None:
            self.executor.execute(way)
            self.executor.settle()
            self._clock.sleep_until(self._clock.now_s() + self._rest_s)
        return way is not None

    def go_home(self, checker: CollisionChecker) -> bool:
        """As `go`, to where the arm looks from."""
        return self.go(self._home(), checker)

    def still_frame(self) -> tuple[RgbdFrame, np.ndarray]:
        """Return a frame and the joints (7,) at which it was taken (see the function of that name)."""
        return still_frame(self._arm, self._camera, self._frame_timeout_s)

    def _home(self) -> np.ndarray:
        return np.append(z1.Q_HOME, self.views.jaw)

    def _q_command(self) -> np.ndarray:
        return np.clip(self._arm.status().q_command, z1.Q_MIN, z1.Q_MAX)

    def _board_in_base(self, frame: RgbdFrame, q: np.ndarray) -> np.ndarray:
        view = detect_board(frame.colour, self._board)
        T_camera_board = estimate_board_pose(view, self._board, camera_model(frame)).T_camera_board
        return self.kinematics.flange(q[: z1.N_ARM]) @ self._T_flange_camera @ T_camera_board


def still_frame(arm: Arm, camera: Camera, timeout_s: float) -> tuple[RgbdFrame, np.ndarray]:
    """Return the next frame during which the arm stood still, and its joints (7,) then [rad].

    Raises:
        MotionError: it moves.
        HalTimeoutError: no frame within `timeout_s` [s].
    """
    before = arm.read_state().q
    moved = np.zeros(z1.N_JOINTS)
    for _ in range(_TRIES):
        frame = camera.wait_for_frame(timeout_s)
        after = arm.read_state().q
        if is_still(before, after):
            return frame, (before + after) / 2
        before, moved = after, np.abs(after - before)
    joint = int(moved[: z1.N_ARM].argmax())
    raise MotionError(
        f"{z1.JOINT_NAMES[joint]} moves by {moved[joint]:.4f} rad while a picture is taken; allowed is "
        f"{STILL_RAD} rad. Hold the arm still, or look for what shakes it."
    )


def is_still(q_before: np.ndarray, q_after: np.ndarray) -> bool:
    """Return whether the arm's six joints are where they were."""
    return bool(np.abs(q_after - q_before)[: z1.N_ARM].max() < STILL_RAD)


def camera_model(frame: RgbdFrame) -> CameraModel:
    """Return the camera as the device describes itself; its colour stream counts as undistorted."""
    i = frame.intrinsics
    return CameraModel.pinhole(fx=i.fx, fy=i.fy, cx=i.cx, cy=i.cy, width=i.width, height=i.height)

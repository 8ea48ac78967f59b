"""Search for the board on the table with the wrist camera, and motions between views of it."""

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
    make_table_checker,
    plan_free_motion,
    scan_scene,
)
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.executor import Executor, MotionError
from z1_runtime.motion.trajectory import MotionLimits

STILL_RAD = 1e-3
"""Maximum change of the joints during an exposure for the arm to count as still [rad]."""

_MAX_FRAMES = 5  # frames tried until the arm is still
_FROM_ABOVE = make_pose(np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]), np.array([0.36, 0.0, 0.38]))
"""T_base_camera with a view of the area near the base, which is out of view from home."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocatedBoard:
    """The board's pose from one frame, with the obstacles around it."""

    T_base_board: np.ndarray
    """(4, 4), by the assumed extrinsics."""
    checker: CollisionChecker
    """Collision checker for the table and the obstacles in view."""
    intrinsics: Intrinsics
    """Intrinsics of the camera."""


class BoardSearch:
    """Search motions of an arm, whose lease must be held, for views of the board.

    Args:
        arm: connected.
        camera: the wrist camera, connected.
        clock: of both devices.
        board: the board to find.
        T_flange_camera: (4, 4) assumed extrinsics.
        views: constraints on the views.
        speed: fraction of the arm's limits that motions use, in (0, 1].
        rest_s: duration of rest before a frame [s].
        frame_timeout_s: maximum duration until a camera frame [s].
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

    def find(self) -> LocatedBoard:
        """Locate the board from home or, when it is not in view there, from above the area near the base.

        Raises:
            CalibrationError: the board is not detected.
            NoTableError: the table is not in view.
            MotionError, HalError: no collision-free motion, or the arm does not follow.
        """
        frame, q = self.capture_still_frame()
        # Obstacles are scanned from home; until then the table is all that is known
        if not self.move_to(self._home(), make_table_checker(self.kinematics, frame, q)):
            raise MotionError(
                "board search: no collision-free motion home from here. Move the arm up by hand, then try again."
            )
        frame, q = self.capture_still_frame()
        checker = scan_scene(self.kinematics, frame, q, self._T_flange_camera)
        try:
            T_base_board = self._board_in_base(frame, q)
        except CalibrationError as error:
            # Another view would show the same board
            if error.code == "wrong_board":
                raise
            above = self.kinematics.best(_FROM_ABOVE @ inverse(self._T_flange_camera) @ z1.T_FLANGE_PIVOT)
            if self.move_to(np.append(above.q, self.views.jaw), checker):
                frame, q = self.capture_still_frame()
            T_base_board = self._board_in_base(frame, q)
        return LocatedBoard(T_base_board=T_base_board, checker=checker, intrinsics=frame.intrinsics)

    def refine(self, found: LocatedBoard) -> LocatedBoard:
        """Locate the board again from the view with most of its corners.

        Raises:
            As `find`; and NoViewpointsError: no such view is reachable.
        """
        (view,) = self.choose_viewpoints(found, 1)
        if not self.move_to(view.q, found.checker):
            raise MotionError(
                "board search: no collision-free motion to the best view. Clear the table around the board."
            )
        frame, q = self.capture_still_frame()
        return replace(found, T_base_board=self._board_in_base(frame, q))

    def choose_viewpoints(
        self, found: LocatedBoard, n: int, *, existing: list[np.ndarray] | None = None, seed: int = 0
    ) -> list[Viewpoint]:
        """Return `n` views, far from each other and from the `existing` camera poses (see `find_viewpoints`)."""
        return find_viewpoints(
            self.kinematics,
            found.checker,
            found.intrinsics,
            found.T_base_board,
            self._board.corners_m,
            q_start=self._q_command(),
            T_flange_camera=self._T_flange_camera,
            existing=existing or [],
            config=replace(self.views, n=n),
            seed=seed,
        )

    def move_to(self, q: np.ndarray, checker: CollisionChecker) -> bool:
        """Move to `q` (7,) and come to rest; return False without a collision-free motion.

        Raises:
            MotionError, HalError: the arm does not follow, or is stopped.
        """
        motion = plan_free_motion(checker, self._q_command(), q, self._limits)
        if motion is not None:
            self.executor.execute(motion)
            self.executor.settle()
            self._clock.sleep_until(self._clock.now_s() + self._rest_s)
        return motion is not None

    def move_home(self, checker: CollisionChecker) -> bool:
        """Move home as `move_to` does."""
        return self.move_to(self._home(), checker)

    def capture_still_frame(self) -> tuple[RgbdFrame, np.ndarray]:
        """Return a frame and the joints (7,) during it (see the function of the same name)."""
        return capture_still_frame(self._arm, self._camera, self._frame_timeout_s)

    def _home(self) -> np.ndarray:
        return np.append(z1.Q_HOME, self.views.jaw)

    def _q_command(self) -> np.ndarray:
        # A command that the servo took from a measured state may be a hair beyond a limit
        return np.clip(self._arm.status().q_command, z1.Q_MIN, z1.Q_MAX)

    def _board_in_base(self, frame: RgbdFrame, q: np.ndarray) -> np.ndarray:
        view = detect_board(frame.colour, self._board)
        T_camera_board = estimate_board_pose(view, self._board, camera_model(frame)).T_camera_board
        return self.kinematics.flange(q[: z1.N_ARM]) @ self._T_flange_camera @ T_camera_board


def capture_still_frame(arm: Arm, camera: Camera, timeout_s: float) -> tuple[RgbdFrame, np.ndarray]:
    """Return the next frame with a still arm, and the joints (7,) during it [rad].

    Raises:
        MotionError: the arm moves.
        HalTimeoutError: no frame within `timeout_s` [s].
    """
    before = arm.read_state().q
    moved = np.zeros(z1.N_JOINTS)
    for _ in range(_MAX_FRAMES):
        frame = camera.wait_for_frame(timeout_s)
        after = arm.read_state().q
        if is_still(before, after):
            # The exposure is between the two readings
            return frame, (before + after) / 2
        before, moved = after, np.abs(after - before)
    joint = int(moved[: z1.N_ARM].argmax())
    raise MotionError(
        f"capture: {z1.JOINT_NAMES[joint]} moves by {moved[joint]:.4f} rad during a frame, allowed is {STILL_RAD} rad. "
        "Hold the arm still, or find the source of its vibration."
    )


def is_still(q_before: np.ndarray, q_after: np.ndarray) -> bool:
    """Return whether the arm's six joints changed by less than `STILL_RAD`."""
    return bool(np.abs(q_after - q_before)[: z1.N_ARM].max() < STILL_RAD)


def camera_model(frame: RgbdFrame) -> CameraModel:
    """Return the camera by the device's intrinsics; its colour stream counts as undistorted."""
    i = frame.intrinsics
    return CameraModel.pinhole(fx=i.fx, fy=i.fy, cx=i.cx, cy=i.cy, width=i.width, height=i.height)

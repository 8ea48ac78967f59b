"""Capture of samples of a calibration board, by planned motions from view to view or with a hand-guided arm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.board.board import Board
from calibration.board.detection import BoardView, detect_board
from calibration.errors import CalibrationError
from calibration.samples import CaptureInfo, Sample, load_samples, open_sample_folder, save_sample
from hal.base import z1
from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.base.transforms import pose_error
from z1_runtime.calibration_session.board_search import BoardSearch, camera_model, capture_still_frame, is_still
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.visualization.rerun_logger import RerunLogger

_ROUNDS = 3  # of views planned to replace unusable ones
_NEW_M, _NEW_RAD = 0.04, 0.15  # a view closer than both to an earlier one is not new
_FRAME_TIMEOUT_S = 5.0
_POLL_S = 0.1  # between reads of the key and the joints
_REST_S = 0.5  # duration of rest before an automatic sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CapturedView:
    """One image of the board, or the reason for its absence."""

    name: str
    """Of the sample on disk; empty for an unusable image."""
    view: BoardView | None
    """The detected corners; None for an unusable image."""
    T_base_camera: np.ndarray
    """(4, 4) camera pose by the assumed extrinsics."""
    message: str = ""
    """Reason of an unusable image, or quality warnings; empty otherwise."""


Key = Literal["", "take", "end"]
"""The operator's key since the last poll."""


class SampleCapture:
    """Capture of samples of one board into a folder; continues an interrupted one.

    Args:
        arm: connected; only read.
        camera: the wrist camera, connected.
        clock: of both devices.
        board: the board to capture.
        folder: of the samples.
        T_flange_camera: (4, 4) assumed extrinsics.
        inspector: logger of the images.
    """

    def __init__(
        self,
        *,
        arm: Arm,
        camera: Camera,
        clock: Clock,
        board: Board,
        folder: Path,
        T_flange_camera: np.ndarray = z1.T_FLANGE_CAMERA,
        inspector: RerunLogger | None = None,
    ) -> None:
        self.captured: list[CapturedView] = []
        """Valid samples of the folder, those of earlier runs first."""
        self._arm, self._camera, self._clock = arm, camera, clock
        self._board, self._folder = board, folder
        self._T_flange_camera = T_flange_camera
        self._tried: list[np.ndarray] = []  # T_base_camera of every image, unusable ones included
        self._kinematics = Kinematics()
        self._inspector = inspector or RerunLogger()

    def open(self, date: str, ground_truth: dict[str, Any] | None = None) -> int:
        """Create the folder or continue in it; return the number of valid samples in it.

        Args:
            date: of the capture, ISO 8601.
            ground_truth: of a twin (see `calibration.samples.CaptureInfo`).

        Raises:
            CalibrationError: `other_session`: the folder holds samples of another board or camera.
        """
        frame = self._camera.wait_for_frame(_FRAME_TIMEOUT_S)
        info = CaptureInfo(
            board=self._board,
            serial=frame.serial,
            setup="eye_in_hand",
            camera=camera_model(frame),
            date=date,
            ground_truth=ground_truth,
        )
        open_sample_folder(self._folder, info)
        loaded = load_samples(self._folder)
        for name, sample in zip(loaded.names, loaded.samples, strict=True):
            T_base_camera = sample.T_base_flange @ self._T_flange_camera
            self._tried.append(T_base_camera)
            try:
                view = detect_board(sample.image, self._board)
            except CalibrationError:  # the solver reports it, and another sample replaces it
                continue
            self.captured.append(CapturedView(name=name, view=view, T_base_camera=T_base_camera))
        return len(self.captured)

    def capture_automatically(self, search: BoardSearch, n_samples: int, seed: int = 0) -> Iterator[CapturedView]:
        """Capture the board from the missing views and yield each image; ends at home.

        Another view replaces an unusable one.

        Args:
            search: for the motions of the arm.
            n_samples: number of samples in the folder at the end.
            seed: of the views.

        Raises:
            As `BoardSearch.find`; and NoViewpointsError: too few views are feasible.
        """
        found = search.find()
        for round_ in range(_ROUNDS):
            missing = n_samples - len(self.captured)
            if missing <= 0:
                break
            for view in search.choose_viewpoints(found, missing, existing=self._tried, seed=seed + round_):
                if search.move_to(view.q, found.checker):
                    yield self.capture_sample()
                else:
                    self._tried.append(view.T_base_camera)
                    message = "a view is left out: no collision-free motion to it"
                    yield CapturedView(name="", view=None, T_base_camera=view.T_base_camera, message=message)
        search.move_home(found.checker)

    def capture_hand_guided(
        self, read_key: Callable[[], Key], n_samples: int, *, automatic: bool = True
    ) -> Iterator[CapturedView]:
        """Yield an image for each key of the operator, and automatically when the arm rests at a new view.

        The arm gets no commands; it must be movable by hand, for example in a passive mode of its controller.

        Args:
            read_key: returns the key since its last call; called ten times a second.
            n_samples: number of samples in the folder at the end.
            automatic: capture without a key, too.
        """
        still_s, q_last = 0.0, self._arm.read_state().q
        while len(self.captured) < n_samples:
            self._clock.sleep_until(self._clock.now_s() + _POLL_S)
            key, q = read_key(), self._arm.read_state().q
            still_s = still_s + _POLL_S if is_still(q_last, q) else 0.0
            q_last = q
            if key == "end":
                return
            if key == "take" or (automatic and still_s >= _REST_S and self._is_new(q)):
                still_s = 0.0
                yield self.capture_sample()

    def capture_sample(self) -> CapturedView:
        """Capture an image at the present pose and save it as a sample if the board is detected.

        Raises:
            MotionError: the arm is not still.
        """
        frame, q = capture_still_frame(self._arm, self._camera, _FRAME_TIMEOUT_S)
        T_base_flange = self._kinematics.flange(q[: z1.N_ARM])
        T_base_camera = T_base_flange @ self._T_flange_camera
        self._tried.append(T_base_camera)
        self._inspector.log_frame(frame, T_base_camera)
        try:
            view = detect_board(frame.colour, self._board)
        except CalibrationError as error:
            return CapturedView(name="", view=None, T_base_camera=T_base_camera, message=str(error))
        sample = Sample(image=frame.colour, T_base_flange=T_base_flange, q=q, stamp_s=frame.stamp_s)
        captured = CapturedView(
            name=save_sample(self._folder, sample),
            view=view,
            T_base_camera=T_base_camera,
            message=" ".join(str(warning) for warning in view.warnings),
        )
        self.captured.append(captured)
        return captured

    def _is_new(self, q: np.ndarray) -> bool:
        T_base_camera = self._kinematics.flange(q[: z1.N_ARM]) @ self._T_flange_camera
        for tried in self._tried:
            distance_m, angle_rad = pose_error(tried, T_base_camera)
            if distance_m < _NEW_M and angle_rad < _NEW_RAD:
                return False
        return True

"""Takes samples of a calibration board: drives the arm from view to view, or watches a hand that guides it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.board.board import Board
from calibration.board.detection import BoardView, detect_board
from calibration.errors import CalibrationError
from calibration.samples import Sample, Session, load_samples, open_session, save_sample
from hal.base import z1
from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.base.transforms import pose_error
from z1_runtime.calibration_session.board_search import BoardSearch, camera_model, is_still, still_frame
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.visualization.rerun_logger import RerunLogger

_ROUNDS = 3
_NEW_M, _NEW_RAD = 0.04, 0.15
_FRAME_TIMEOUT_S = 5.0
_POLL_S, _REST_S = 0.1, 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Taken:
    """One picture of the board, or why there is none."""

    name: str
    """Of the sample on disk; empty when the picture could not be used."""
    view: BoardView | None
    """What was detected."""
    T_base_camera: np.ndarray
    """(4, 4) where the camera was, by the mount assumed."""
    problem: str = ""
    """What is wrong with the picture, or doubtful; empty when nothing is."""


Key = Literal["", "take", "end"]
"""What an operator has pressed since the last look."""


class Capture:
    """Fills one folder with samples of one board; goes on where an interrupted session stopped.

    Args:
        arm: connected; only looked at.
        camera: the wrist camera, connected.
        clock: the one both live by.
        board: to be seen.
        folder: of the samples.
        T_flange_camera: (4, 4) the mount as far as it is known.
        inspector: where the pictures are shown.
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
        self.taken: list[Taken] = []
        """Samples of the folder, those of earlier runs first."""
        self._arm, self._camera, self._clock = arm, camera, clock
        self._board, self._folder = board, folder
        self._T_flange_camera = T_flange_camera
        self._tried: list[np.ndarray] = []  # T_base_camera of every picture, the useless ones too
        self._kinematics = Kinematics()
        self._inspector = inspector or RerunLogger()

    def open(self, date: str, truth: dict[str, Any] | None = None) -> int:
        """Make the folder, or take up what is in it; return how many usable samples it holds already.

        Args:
            date: of the session, ISO 8601.
            truth: what only a twin knows (see `calibration.samples.Session`).

        Raises:
            CalibrationError: the folder holds samples of another board or camera.
        """
        frame = self._camera.wait_for_frame(_FRAME_TIMEOUT_S)
        session = Session(
            board=self._board,
            serial=frame.serial,
            setup="eye_in_hand",
            camera=camera_model(frame),
            date=date,
            truth=truth,
        )
        open_session(self._folder, session)
        loaded = load_samples(self._folder)
        for name, sample in zip(loaded.names, loaded.samples, strict=True):
            T_base_camera = sample.T_base_flange @ self._T_flange_camera
            self._tried.append(T_base_camera)
            try:
                view = detect_board(sample.image, self._board)
            except CalibrationError:  # left for the solver to tell, and made up for
                continue
            self.taken.append(Taken(name=name, view=view, T_base_camera=T_base_camera))
        return len(self.taken)

    def drive(self, search: BoardSearch, wanted: int, seed: int = 0) -> Iterator[Taken]:
        """Look at the board from the views still missing and yield each picture; ends at home.

        A view that cannot be used is made up for by another one.

        Args:
            search: drives the arm.
            wanted: how many samples the folder is to hold.
            seed: of the views.

        Raises:
            As `BoardSearch.find`; and NoViewpointsError: too few views are within reach.
        """
        found = search.find()
        for round_ in range(_ROUNDS):
            missing = wanted - len(self.taken)
            if missing <= 0:
                break
            for view in search.choose(found, missing, taken=self._tried, seed=seed + round_):
                if search.go(view.q, found.checker):
                    yield self.take()
                else:
                    self._tried.append(view.T_base_camera)
                    problem = "one view is left out: there is no free way to it"
                    yield Taken(name="", view=None, T_base_camera=view.T_base_camera, problem=problem)
        search.go_home(found.checker)

    def follow_hand(self, pressed: Callable[[], Key], wanted: int, *, by_itself: bool = True) -> Iterator[Taken]:
        """Yield a picture whenever the operator asks for one, or by itself when a new view is held still.

        Nothing is sent to the arm: something else lets it be moved, such as a passive mode of its controller.

        Args:
            pressed: returns what was pressed since it was last called; asked ten times a second.
            wanted: how many samples the folder is to hold.
            by_itself: take pictures unasked, too.
        """
        still_s, q_last = 0.0, self._arm.read_state().q
        while len(self.taken) < wanted:
            self._clock.sleep_until(self._clock.now_s() + _POLL_S)
            key, q = pressed(), self._arm.read_state().q
            still_s = still_s + _POLL_S if is_still(q_last, q) else 0.0
            q_last = q
            if key == "end":
                return
            if key == "take" or (by_itself and still_s >= _REST_S and self._is_new(q)):
                still_s = 0.0
                yield self.take()

    def take(self) -> Taken:
        """Take a picture from where the arm stands; it is on disk when this returns, if the board can be used.

        Raises:
            MotionError: the arm does not stand still.
        """
        frame, q = still_frame(self._arm, self._camera, _FRAME_TIMEOUT_S)
        T_base_flange = self._kinematics.flange(q[: z1.N_ARM])
        T_base_camera = T_base_flange @ self._T_flange_camera
        self._tried.append(T_base_camera)
        self._inspector.log_frame(frame, T_base_camera)
        try:
            view = detect_board(frame.colour, self._board)
        except CalibrationError as error:
            return Taken(name="", view=None, T_base_camera=T_base_camera, problem=str(error))
        sample = Sample(image=frame.colour, T_base_flange=T_base_flange, q=q, stamp_s=frame.stamp_s)
        taken = Taken(
            name=save_sample(self._folder, sample),
            view=view,
            T_base_camera=T_base_camera,
            problem=" ".join(str(warning) for warning in view.warnings),
        )
        self.taken.append(taken)
        return taken

    def _is_new(self, q: np.ndarray) -> bool:
        T_base_camera = self._kinematics.flange(q[: z1.N_ARM]) @ self._T_flange_camera
        for tried in self._tried:
            distance_m, angle_rad = pose_error(tried, T_base_camera)
            if distance_m < _NEW_M and angle_rad < _NEW_RAD:
                return False
        return True

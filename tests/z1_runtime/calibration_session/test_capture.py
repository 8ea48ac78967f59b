"""Capture of samples: planned or hand-guided, saved at once, and never from a moving arm."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calibration.board.board import Board
from calibration.errors import CalibrationError
from calibration.samples import load_samples
from hal.base import z1
from hal.base.messages import ArmState, RgbdFrame
from hal.base.transforms import pose_error
from hal.rig import connect_rig
from scripts.support.calibration_robot import CalibrationRobot, RobotOptions, open_robot
from sim_twin.backends import make_rig
from sim_twin.model.scene import SceneConfig
from tests.support.errors import raises
from z1_runtime.calibration_session.board_search import BoardSearch, capture_still_frame
from z1_runtime.calibration_session.capture import Key, SampleCapture
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.motion.executor import Executor, MotionError
from z1_runtime.motion.trajectory import MotionLimits, joint_move

pytestmark = pytest.mark.integration

BOARD = Board()


@pytest.fixture(scope="module")
def robot() -> Iterator[CalibrationRobot]:
    with open_robot(RobotOptions(mount_error_m=0.004, mount_error_deg=1.5), BOARD, seed=0) as robot:
        robot.arm.claim("test")
        yield robot


def capture_into(folder: Path, robot: CalibrationRobot, board: Board = BOARD) -> SampleCapture:
    return SampleCapture(arm=robot.arm, camera=robot.camera, clock=robot.clock, board=board, folder=folder)


def search_with(robot: CalibrationRobot) -> BoardSearch:
    return BoardSearch(arm=robot.arm, camera=robot.camera, clock=robot.clock, board=BOARD, speed=1.0)


@pytest.fixture(scope="module")
def folder(robot: CalibrationRobot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder whose capture was interrupted after one of three samples, and taken up again."""
    folder = tmp_path_factory.mktemp("samples")
    first = capture_into(folder, robot)
    assert first.open("2026-01-01T00:00:00+00:00") == 0
    pictures = first.capture_automatically(search_with(robot), n_samples=3)
    name = next(pictures).name
    pictures.close()  # as Ctrl-C does
    assert [path.stem for path in folder.glob("0*.json")] == [name]

    second = capture_into(folder, robot)
    assert second.open("2026-01-01T00:01:00+00:00") == 1
    assert sum(bool(captured.name) for captured in second.capture_automatically(search_with(robot), n_samples=3)) == 2
    assert len(second.captured) == 3
    return folder


def test_interrupted_capture_is_continued(folder: Path):
    loaded = load_samples(folder)
    assert len(loaded.samples) == 3 and not loaded.warnings
    assert loaded.info.date == "2026-01-01T00:00:00+00:00"
    assert loaded.info.serial.startswith("twin-4mm")


def test_each_sample_has_the_pose_of_the_arm(folder: Path):
    kinematics = Kinematics()
    for sample in load_samples(folder).samples:
        assert np.allclose(sample.T_base_flange, kinematics.flange(sample.q[:6]))


def test_samples_after_the_interruption_are_new_views(folder: Path):
    poses = [sample.T_base_flange for sample in load_samples(folder).samples]
    for i, pose in enumerate(poses):
        for other in poses[:i]:
            distance_m, angle_rad = pose_error(pose, other)
            assert np.hypot(angle_rad, distance_m / 0.35) > 0.3


def test_a_driven_capture_ends_at_home(robot: CalibrationRobot, folder: Path):
    assert np.allclose(robot.arm.read_state().q[:6], z1.Q_HOME, atol=5e-3)


def test_samples_of_another_board_are_not_mixed_in(robot: CalibrationRobot, folder: Path):
    with raises(CalibrationError, "other_session"):
        capture_into(folder, robot, Board(square_m=0.03, marker_m=0.02)).open("2026-01-01T00:02:00+00:00")
    assert len(load_samples(folder).samples) == 3


def move(robot: CalibrationRobot, q: np.ndarray) -> None:
    start = robot.arm.status().q_command
    Executor(robot.arm, robot.clock).execute(joint_move(start, q, MotionLimits.at_speed(1.0)))


class Operator:
    """Operator who guides the arm to joint positions, one every 20 polls, and presses keys at given polls."""

    def __init__(self, robot: CalibrationRobot, moves: list[np.ndarray], keys: dict[int, Key]) -> None:
        self._robot, self._keys = robot, keys
        self._moves, self._asked = dict(zip(range(20, 1000, 20), moves, strict=False)), 0

    def __call__(self) -> Key:
        self._asked += 1
        if (q := self._moves.get(self._asked)) is not None:
            move(self._robot, q)
        return self._keys.get(self._asked, "end" if self._asked > 100 else "")


def test_a_guided_arm_is_sampled_when_it_holds_a_new_view_still(robot: CalibrationRobot, tmp_path: Path):
    capture = capture_into(tmp_path, robot)
    capture.open("2026-01-01T00:00:00+00:00")
    views = [
        np.append(q, 0.0) for q in ([0.33, 0.96, -0.24, -0.15, -0.37, 1.8], [0.56, 2.05, -1.35, 1.01, -0.62, 1.87])
    ]
    move(robot, views[0])
    past_the_board = np.append(z1.Q_HOME, 0.0)
    past_the_board[0] = 1.2
    taken = list(capture.capture_hand_guided(Operator(robot, [past_the_board, views[1]], {}), n_samples=2))
    assert [one.name for one in taken] == ["0001", "", "0002"]  # a view without the board is tried once
    for q, sample in zip(views, load_samples(tmp_path).samples, strict=True):
        assert np.abs(sample.q - q).max() < 5e-3


def test_operator_captures_and_ends_and_nothing_moves_the_arm(robot: CalibrationRobot, tmp_path: Path):
    capture = capture_into(tmp_path, robot)
    capture.open("2026-01-01T00:00:00+00:00")
    operator = Operator(robot, [], {3: "take", 7: "take", 9: "end"})
    before = robot.arm.status().trajectory_id
    taken = list(capture.capture_hand_guided(operator, n_samples=20, automatic=False))
    assert [one.name for one in taken] == ["0001", "0002"]
    assert robot.arm.status().trajectory_id == before


def test_table_without_the_board_is_reported(tmp_path: Path):
    with ExitStack() as undo:
        robot = undo.enter_context(connect_rig(make_rig(SceneConfig(object="box"), lockstep=True)))
        robot.arm.claim("test")
        devices = {"arm": robot.arm, "camera": robot.camera, "clock": robot.clock, "board": BOARD}
        capture = SampleCapture(**devices, folder=tmp_path)
        capture.open("2026-01-01T00:00:00+00:00")
        with raises(CalibrationError, "no_board"):
            next(capture.capture_automatically(BoardSearch(**devices, speed=1.0), n_samples=3))
        assert not load_samples(tmp_path).samples


class ShakyArm:
    """An arm that has moved at each of its first reads."""

    def __init__(self, shakes: int) -> None:
        self._shakes, self._reads = shakes, 0

    def read_state(self) -> ArmState:
        self._reads += 1
        q = np.append(z1.Q_HOME, 0.0)
        q[3] += 0.01 * min(self._reads, self._shakes)
        return ArmState(stamp_s=0.0, q=q, dq=np.zeros(7), tau=np.zeros(7))


class StillCamera:
    """A camera with a constant frame."""

    def __init__(self, frame: RgbdFrame) -> None:
        self._frame = frame

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        return self._frame


def test_frame_of_a_moving_arm_is_captured_again(robot: CalibrationRobot):
    camera = StillCamera(robot.camera.wait_for_frame(1.0))
    _, q = capture_still_frame(ShakyArm(3), camera, 1.0)  # pyright: ignore[reportArgumentType] (what is used of them)
    assert q[3] == pytest.approx(z1.Q_HOME[3] + 0.03)
    with pytest.raises(MotionError) as caught:
        capture_still_frame(ShakyArm(100), camera, 1.0)  # pyright: ignore[reportArgumentType]
    assert "joint4 moves by 0.0100 rad" in str(caught.value) and "allowed is 0.001 rad" in str(caught.value)


def test_the_coverage_grows_with_every_sample(robot: CalibrationRobot, folder: Path):
    from z1_runtime.calibration_session.coverage import Coverage

    capture = capture_into(folder, robot)
    capture.open("2026-01-01T00:00:00+00:00")
    covers = [Coverage.of(capture.captured[:n]) for n in range(4)]
    ratios = [(cover.corners > 0).mean() for cover in covers]
    assert ratios[0] == 0.0 and ratios[-1] > 0.3
    assert all(after >= before for before, after in pairwise(ratios))
    assert covers[1].rotation_spread_deg.max() == 0.0 and covers[3].rotation_spread_deg.max() > 20.0
    assert covers[3].draw_map().count("\n") == 8 and "°" in covers[3].summary()

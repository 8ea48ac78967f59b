"""The recording holds the logged entries at the layout's paths, and never delays its callers."""

from __future__ import annotations

import socket
import threading
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import trimesh
from rerun.chunk import RrdReader
from scipy.spatial import KDTree

from hal.base import z1
from hal.base.messages import ArmState, Intrinsics, RgbdFrame, ServoMode, ServoStatus
from models.obb.obb import OrientedBox
from models.types import Detection, GraspSet
from tests.support.errors import raises
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.geometry.kinematics import Kinematics
from z1_runtime.types import (
    GraspPlan,
    JointTrajectory,
    Observation,
    Plane,
    PlanningStage,
    Rejection,
    RejectionReason,
)
from z1_runtime.visualization import blueprint
from z1_runtime.visualization.archetypes import gripper_strips
from z1_runtime.visualization.recorder import Recorder, ViewerPortError
from z1_runtime.visualization.rerun_logger import RerunLogger
from z1_runtime.visualization.robot_view import LINKS, RobotView

K = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
Q = np.append(z1.Q_HOME, -1.0)


def make_frame(stamp_s: float) -> RgbdFrame:
    depth = np.linspace(0.2, 0.6, K.width * K.height, dtype=np.float32).reshape(K.height, K.width)
    return RgbdFrame(
        colour=np.full((K.height, K.width, 3), 90, np.uint8),
        depth_m=depth,
        intrinsics=K,
        stamp_s=stamp_s,
        sequence=int(10 * stamp_s),
    )


def make_observation(stamp_s: float) -> Observation:
    points = np.random.default_rng(0).uniform((-0.05, -0.05, 0.3), (0.05, 0.05, 0.4), (300, 3))
    return Observation(
        frame=make_frame(stamp_s),
        T_base_camera=np.eye(4),
        detection=Detection(label="bottle", confidence=0.9, box_px=(1, 2, 30, 40)),
        object_points=points[:100],
        scene_points=points[100:],
        table=Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-0.1),
    )


def make_arm(stamp_s: float, mode: ServoMode = ServoMode.TRACKING) -> tuple[ArmState, ServoStatus]:
    state = ArmState(stamp_s=stamp_s, q=Q, dq=np.zeros(7), tau=np.zeros(7))
    status = ServoStatus(
        stamp_s=stamp_s,
        mode=mode,
        reason="a reason" if mode is ServoMode.BRAKING else "",
        owner="test",
        trajectory_id=1,
        trajectory_time_s=stamp_s,
        buffered_s=0.1,
        finished=False,
        q_command=Q,
        ticks=1,
        overruns=0,
        period_ms_p50=2.0,
        period_ms_p999=2.1,
    )
    return state, status


def make_plan() -> GraspPlan:
    q = np.linspace(Q, Q + 0.1, 50)
    leg = JointTrajectory(t_s=np.linspace(0.0, 0.1, 50), q=q, dq=np.zeros((50, 7)))
    return GraspPlan(
        rank=1,
        T_base_grasp=np.eye(4),
        width_m=0.05,
        T_base_pivot=np.eye(4),
        jaw_open=-1.0,
        jaw_contact=-0.3,
        **{field.name: leg for field in fields(GraspPlan) if field.type == "JointTrajectory"},
        rejections=(Rejection(rank=0, reason=RejectionReason.IK, stage=PlanningStage.IK, detail="out of reach"),),
    )


def make_grasps(n: int) -> GraspSet:
    return GraspSet(
        T_camera_grasps=np.tile(np.eye(4), (n, 1, 1)), scores=np.linspace(0, 1, n), widths_m=np.full(n, np.nan)
    )


def log_everything(logger: RerunLogger) -> None:
    box = OrientedBox(
        T_camera_box=np.eye(4), half_extents_m=np.array([0.03, 0.04, 0.1]), unobserved=np.zeros(3, dtype=bool)
    )
    logger.log_phase("look", 0.0)
    for step in range(20):
        logger.log_arm(*make_arm(step / 10))
        logger.log_frame(make_frame(step / 10), np.eye(4))
    logger.log_arm(*make_arm(2.0, ServoMode.BRAKING))
    logger.log_observation(make_observation(2.0))
    logger.log_planning_scene(PlanningScene.from_observation(make_observation(2.0), None, Kinematics()))
    logger.log_box(box, np.array([1, 4]), np.eye(4))
    logger.log_candidates(make_grasps(30), np.eye(4))
    logger.log_plan(make_plan())
    logger.log_stage_times({"detect": 1.5, "total": 20.0})


def read_entities(path: Path) -> dict[str, int]:
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        name = chunk.entity_path.strip("/")
        rows[name] = rows.get(name, 0) + chunk.num_rows
    return rows


@pytest.fixture
def held_worker(monkeypatch: pytest.MonkeyPatch):
    """Keep every worker from drawing until the event is set."""
    go = threading.Event()
    write_static = Recorder.write_static

    def wait_first(self: Recorder) -> None:
        go.wait()
        write_static(self)

    monkeypatch.setattr(Recorder, "write_static", wait_first)
    yield go
    go.set()


def test_recording_holds_every_kind_of_entry(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "episode.rrd"
    logger = RerunLogger(path)
    log_everything(logger)
    logger.close()
    rows = read_entities(path)
    wanted = {value for name, value in vars(blueprint).items() if name.isupper() and name not in ("TIMELINE",)}
    assert wanted - {blueprint.ARM} <= set(rows)
    assert {f"{blueprint.ARM}/{link}" for link in LINKS} <= set(rows)
    assert rows[blueprint.POSITION] >= 21
    assert logger.lost == 0


def test_recording_holds_the_layout(tmp_path: Path) -> None:
    path = tmp_path / "episode.rrd"
    logger = RerunLogger(path)
    logger.close()
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    entities = {chunk.entity_path for chunk in reader.stream(store=layout).to_chunks()}
    assert sum(entity.startswith("/view/") and entity.count("/") == 2 for entity in entities) == 8


def test_times_are_those_of_the_messages(tmp_path: Path) -> None:
    path = tmp_path / "episode.rrd"
    logger = RerunLogger(path)
    logger.log_phase("look", 12.5)
    logger.log_stage_times({"total": 1.0})  # carries no time: takes the newest
    logger.close()
    stamps = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if blueprint.TIMELINE in chunk.timeline_names:
            stamps[chunk.entity_path.strip("/")] = chunk.to_record_batch().column(blueprint.TIMELINE)[0].value
    assert stamps[blueprint.PHASE] == stamps[blueprint.STAGES] == 12_500_000_000


def test_full_queue_drops_oldest_frames_first_and_keeps_the_rest(tmp_path: Path, held_worker: threading.Event) -> None:
    path = tmp_path / "episode.rrd"
    logger = RerunLogger(path, max_frames=2, max_jobs=50)
    for step in range(40):
        logger.log_frame(make_frame(float(step)), np.eye(4))
        logger.log_phase(f"phase {step}", float(step))
    assert logger.frames_dropped == 38
    assert logger.lost == 0
    held_worker.set()
    logger.close()
    rows = read_entities(path)
    assert rows[blueprint.COLOUR] == 2
    assert rows[blueprint.PHASE] == 40


def test_caller_continues_while_the_worker_hangs(tmp_path: Path, held_worker: threading.Event) -> None:
    logger = RerunLogger(tmp_path / "episode.rrd", max_jobs=10)
    for step in range(25):
        logger.log_phase("busy", float(step))
    assert logger.lost == 15
    logger.close(timeout_s=0.01)


def test_fault_in_a_drawing_ends_the_recording_not_the_caller(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    logger = RerunLogger(tmp_path / "episode.rrd")
    logger.log_stage_times({"total": "no number"})  # pyright: ignore[reportArgumentType]
    logger.close()
    assert "the recording ends here" in caplog.text


def test_frames_above_the_rate_are_thinned_by_their_stamps(tmp_path: Path) -> None:
    path = tmp_path / "episode.rrd"
    logger = RerunLogger(path, frame_rate_hz=5.0, max_frames=100)
    for step in range(60):
        logger.log_frame(make_frame(step / 30), np.eye(4))
    logger.close()
    assert read_entities(path)[blueprint.COLOUR] == 10
    assert logger.frames_dropped == 0


def test_logger_without_sinks_does_nothing() -> None:
    before = threading.active_count()
    logger = RerunLogger()
    log_everything(logger)
    assert threading.active_count() == before
    logger.close()
    logger.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def listening_addresses(port: int) -> set[str]:
    """Return the local addresses (hex, as the kernel writes them) of listeners on `port`."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            address, hex_port = local.split(":")
            if state == "0A" and int(hex_port, 16) == port:
                found.add(address)
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux's socket table")
def test_live_view_listens_on_the_loopback_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    port = free_port()
    logger = RerunLogger(live=True, port=port)
    with socket.create_connection(("127.0.0.1", port), timeout=20):
        assert listening_addresses(port) == {"0100007F"}
    logger.close()


def test_taken_port_is_one_clear_error() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with raises(ViewerPortError, "viewer_port") as caught:
            RerunLogger(live=True, port=port)
        assert str(port) in str(caught.value)


def test_drawn_pivot_agrees_with_the_kinematics() -> None:
    q = np.random.default_rng(1).uniform(z1.Q_MIN, z1.Q_MAX, (20, 7))
    kinematics = Kinematics()
    wanted = [(kinematics.flange(row[:6]) @ z1.T_FLANGE_PIVOT)[:3, 3] for row in q]
    assert np.allclose(RobotView().pivot_path(q), wanted, atol=1e-9)


def test_gripper_strip_ends_at_the_fingertips_on_both_sides_of_the_grasp() -> None:
    strip = gripper_strips(np.eye(4)[None], np.array([0.08]))[0]
    assert np.allclose(strip[[3, 6]], [[0, -0.04, 0], [0, 0.04, 0]])
    assert strip[0, 2] == strip[:, 2].min() < 0  # the stem is behind the grasp: z is the approach


def test_viewer_opens_on_a_screen_and_stays_on_the_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("subprocess.Popen", lambda command, **more: started.append(command))
    port = free_port()
    RerunLogger(live=True, port=port).close()
    (command,) = started
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert command[-1] == f"rerun+http://127.0.0.1:{port}/proxy"


@pytest.mark.integration
def test_drawn_meshes_are_the_robot_s_within_the_grid() -> None:
    drawn = {path: entity for path, entity in RobotView().draw_links() if isinstance(entity, rr.Mesh3D)}
    for stem, link in (("z1_Link01", "link01"), ("z1_GripperMover", "gripperMover")):
        mesh = drawn[f"{blueprint.ARM}/{link}"]
        assert mesh.vertex_positions is not None
        vertices = np.array(mesh.vertex_positions.as_arrow_array().to_pylist())
        whole = trimesh.load_mesh(z1.mesh_dir() / "collision" / f"{stem}.STL")
        assert np.allclose([vertices.min(axis=0), vertices.max(axis=0)], whole.bounds, atol=0.002)
        distance, _ = KDTree(vertices).query(whole.vertices)
        assert distance.max() < 0.002 * np.sqrt(3)

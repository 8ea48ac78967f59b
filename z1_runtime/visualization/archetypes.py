"""Rerun archetypes of the project's types; pure functions that yield (entity path, archetype)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import cv2
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from hal.base.messages import ArmState, Intrinsics, RgbdFrame, ServoStatus
from models.obb.obb import OrientedBox
from models.types import GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.types import GraspPlan, Observation
from z1_runtime.visualization import blueprint
from z1_runtime.visualization.robot_view import Drawing, RobotView

_JPEG_QUALITY = 80
_DEPTH_STEPS_PER_M = 1000.0  # 1 mm is finer than a screen shows, and compresses far better than 0.1 mm of noise
_SCENE_POINTS = 30_000  # a tenth of a frame's 307 200 pixels
_PATH_POINTS = 200  # per motion, which has 500 samples a second
_FINGER_M = 0.04
_DEFAULT_WIDTH_M = 0.06  # drawn where the generator gives no width
_OBJECT_COLOUR = (255, 140, 0)
_CHOSEN_COLOUR = (0, 220, 90)
_OBSTACLE_COLOUR, _OCCLUDED_COLOUR = (200, 60, 60), (150, 120, 200)


def draw_frame(frame: RgbdFrame, T_base_camera: np.ndarray) -> Drawing:
    """Camera pose and frustum, colour as JPEG, depth as 16-bit PNG."""
    k = frame.intrinsics
    yield blueprint.CAMERA, rr.Transform3D(translation=T_base_camera[:3, 3], mat3x3=T_base_camera[:3, :3])
    yield (
        blueprint.CAMERA,
        rr.Pinhole(
            image_from_camera=k.K,
            resolution=[k.width, k.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.08,  # length of the drawn frustum [m]
        ),
    )
    _, jpeg = cv2.imencode(".jpg", frame.colour[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    yield blueprint.COLOUR, rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
    steps = np.clip(np.round(frame.depth_m * _DEPTH_STEPS_PER_M), 0, 65535).astype(np.uint16)
    _, png = cv2.imencode(".png", steps)
    yield (
        blueprint.DEPTH,
        rr.EncodedDepthImage(png.tobytes(), media_type="image/png", meter=_DEPTH_STEPS_PER_M, depth_range=(70, 800)),
    )


def draw_observation(observation: Observation) -> Drawing:
    """Both clouds in base, and the detection."""
    T, frame = observation.T_base_camera, observation.frame
    scene = observation.scene_points[
        :: max(1, -(-len(observation.scene_points) // _SCENE_POINTS))
    ]  # the negations round up
    yield (
        blueprint.SCENE,
        rr.Points3D(_to_base(scene, T), colors=_colours_at(scene, frame.colour, frame.intrinsics), radii=0.001),
    )
    yield blueprint.OBJECT, rr.Points3D(_to_base(observation.object_points, T), colors=_OBJECT_COLOUR, radii=0.0012)
    found = observation.detection
    text = (
        f"{found.label} at {found.box_px}, confidence {found.confidence:.2f}, {len(observation.object_points)} points"
    )
    yield blueprint.LOG, rr.TextLog(text, level="INFO")


def draw_planning_scene(scene: PlanningScene) -> Drawing:
    """Points that ranking and planning keep clear of, and where the object may continue unobserved; both in base."""
    obstacles = scene.scene_index.points[:: max(1, -(-len(scene.scene_index) // _SCENE_POINTS))]
    yield blueprint.OBSTACLES, rr.Points3D(obstacles, colors=_OBSTACLE_COLOUR, radii=0.0015)
    yield blueprint.OCCLUDED, rr.Points3D(scene.occluded_points, colors=_OCCLUDED_COLOUR, radii=0.0012)


def draw_box(box: OrientedBox | None, faces: np.ndarray, T_base_camera: np.ndarray) -> Drawing:
    """The box, and its faces that may be approached: filled, with their outward normals."""
    if box is None:
        yield blueprint.BOX, rr.Clear(recursive=False)
        yield blueprint.BOX_FACES, rr.Clear(recursive=True)
        return
    T_base_box = T_base_camera @ box.T_camera_box
    R, half = T_base_box[:3, :3], box.half_extents_m
    yield blueprint.BOX, _boxes(T_base_box, np.zeros((1, 3)), half[None], (90, 160, 255), fill="majorwireframe")
    axes, signs = np.asarray(faces) // 2, 1.0 - 2.0 * (np.asarray(faces) % 2)
    offsets, plates = np.zeros((len(axes), 3)), np.tile(half, (len(axes), 1))
    rows = np.arange(len(axes))
    offsets[rows, axes] = signs * half[axes]
    plates[rows, axes] = 2e-4  # a face is a box of almost no thickness
    yield blueprint.BOX_FACES, _boxes(T_base_box, offsets, plates, (90, 160, 255, 90), fill="solid")
    yield (
        f"{blueprint.BOX_FACES}/normals",
        rr.Arrows3D(
            origins=offsets @ R.T + T_base_box[:3, 3],
            vectors=0.04 * (R[:, axes] * signs).T,
            colors=(90, 160, 255),
            radii=0.001,
        ),
    )


def draw_candidates(grasps: GraspSet, T_base_camera: np.ndarray) -> Drawing:
    """Every candidate as a small gripper, red (score 0) to green (score 1)."""
    scores = np.clip(grasps.scores, 0.0, 1.0)
    colours = np.column_stack([255 * (1 - scores), 220 * scores, np.full(len(scores), 60), np.full(len(scores), 110)])
    strips = gripper_strips(T_base_camera @ grasps.T_camera_grasps, grasps.widths_m)
    yield blueprint.CANDIDATES, rr.LineStrips3D(strips, colors=colours.astype(np.uint8), radii=0.0004)


def draw_plan(plan: GraspPlan, robot: RobotView) -> Drawing:
    """The chosen grasp, the pivot's path through transfer, approach and lift, and the counts of rejections."""
    strips = gripper_strips(plan.T_base_grasp[None], np.array([plan.width_m]))
    yield blueprint.GRASP, rr.LineStrips3D(strips, colors=_CHOSEN_COLOUR, radii=0.002)
    legs = [leg.q[:: max(1, len(leg.q) // _PATH_POINTS)] for leg in (plan.transfer, plan.approach, plan.lift)]
    colours = [(120, 120, 255), (255, 200, 0), _CHOSEN_COLOUR]
    yield blueprint.PATH, rr.LineStrips3D([robot.pivot_path(q) for q in legs], colors=colours, radii=0.001)
    counts = Counter(rejection.reason for rejection in plan.rejections)
    rejections = ", ".join(f"{n} × {reason}" for reason, n in counts.most_common()) or "none"
    yield (
        blueprint.LOG,
        rr.TextLog(f"candidate {plan.rank} chosen ({plan.ik_method} IK); rejections: {rejections}", level="INFO"),
    )


def draw_arm(state: ArmState, status: ServoStatus, robot: RobotView) -> Drawing:
    """The robot's pose, and its measured and commanded joints."""
    yield from robot.draw_pose(state.q)
    yield blueprint.POSITION, rr.Scalars(state.q)
    yield blueprint.COMMAND, rr.Scalars(status.q_command)
    yield blueprint.TORQUE, rr.Scalars(state.tau)


def draw_servo_change(status: ServoStatus) -> Drawing:
    """The servo's mode as a lane, and its reason in the log."""
    yield blueprint.SERVO, rr.StateChange(state=status.mode.value)
    if status.reason:
        yield blueprint.LOG, rr.TextLog(f"servo {status.mode.value}: {status.reason}", level="WARN")


def draw_phase(name: str) -> Drawing:
    """The phase as a lane and in the log."""
    yield blueprint.PHASE, rr.StateChange(state=name)
    yield blueprint.LOG, rr.TextLog(f"phase {name}", level="INFO")


def draw_stage_times(stage_ms: Mapping[str, float]) -> Drawing:
    """Stage times as a table."""
    rows = "\n".join(f"| {name} | {ms:.2f} |" for name, ms in stage_ms.items())
    yield blueprint.STAGES, rr.TextDocument(f"| stage | ms |\n|---|---:|\n{rows}", media_type="text/markdown")


def gripper_strips(T_base_grasps: np.ndarray, widths_m: np.ndarray) -> np.ndarray:
    """Return a parallel jaw per grasp as one line strip, (N, 7, 3) [m]: stem, palm, both fingers."""
    half = np.where(np.isfinite(widths_m), widths_m, _DEFAULT_WIDTH_M) / 2
    back, palm = -2 * _FINGER_M, -_FINGER_M
    y_sign = np.array([0, 0, -1, -1, -1, 1, 1])
    z = np.array([back, palm, palm, 0.0, palm, palm, 0.0])
    local = np.zeros((len(half), 7, 3))
    local[..., 1], local[..., 2] = half[:, None] * y_sign, z
    R, p = T_base_grasps[:, :3, :3], T_base_grasps[:, None, :3, 3]
    return (np.einsum("nij,nkj->nki", R, local) + p).astype(np.float32)


def _boxes(T: np.ndarray, offsets: np.ndarray, half: np.ndarray, colour: tuple[int, ...], *, fill: str) -> rr.Boxes3D:
    xyzw = Rotation.from_matrix(T[:3, :3]).as_quat()
    return rr.Boxes3D(
        centers=offsets @ T[:3, :3].T + T[:3, 3],
        half_sizes=half,
        quaternions=[rr.Quaternion(xyzw=xyzw)] * len(half),
        colors=colour,
        fill_mode=fill,  # pyright: ignore[reportArgumentType]
        radii=0.0008,
    )


def _to_base(points: np.ndarray, T_base_camera: np.ndarray) -> np.ndarray:
    return (points @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]).astype(np.float32)


def _colours_at(points: np.ndarray, colour: np.ndarray, k: Intrinsics) -> np.ndarray:
    """Return the image's colour (N, 3) at the pixels of `points` (N, 3), which are in the camera frame."""
    z = np.maximum(points[:, 2], 1e-6)  # a point at the camera centre has no pixel
    u = np.clip(np.round(k.fx * points[:, 0] / z + k.cx), 0, k.width - 1).astype(int)
    v = np.clip(np.round(k.fy * points[:, 1] / z + k.cy), 0, k.height - 1).astype(int)
    return colour[v, u]

"""The samples of a hand-eye calibration in Rerun: camera poses, detected corners and expected corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from calibration.board.board import Board
from calibration.board.detection import BoardView
from calibration.camera_model import CameraModel
from calibration.hand_eye.solver import HandEyeResult
from calibration.samples import Sample
from hal.base.transforms import inverse, transform_points
from z1_runtime.visualization import blueprint
from z1_runtime.visualization.robot_view import Drawing, RobotView

TIMELINE = "sample"
BOARD = "world/board"
CAMERAS = "world/cameras"
RESIDUAL = "residual_px"

_DETECTED, _EXPECTED, _DROPPED = (0, 220, 90), (255, 60, 60), (150, 150, 150)
_FRUSTUM_M, _SMALL_FRUSTUM_M = 0.06, 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolvedSamples:
    """Samples of one calibration with its result."""

    board: Board
    """The calibration board in the samples."""
    camera: CameraModel
    """Camera model that projects the corners."""
    names: Sequence[str]
    """(N,) names of the samples."""
    samples: Sequence[Sample]
    """(N,)."""
    views: Sequence[BoardView]
    """(N,) detected corners of each sample."""
    result: HandEyeResult
    """Eye-in-hand result."""


def write_recording(path: Path, solved: SolvedSamples) -> None:
    """Write `path` (.rrd): arm, board and all cameras in space; per sample the image with its corners."""
    stream = rr.RecordingStream("z1_calibration")
    # As in `Recorder`: these timelines would double the size of every entry
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.set_sinks(rr.FileSink(str(path)), default_blueprint=_blueprint())
    robot = RobotView()
    stream.log(blueprint.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for entity, archetype in (*robot.draw_links(), *_draw_board(solved), *_draw_cameras(solved)):
        stream.log(entity, archetype, static=True)
    for number in range(len(solved.samples)):
        stream.set_time(TIMELINE, sequence=number + 1)
        for entity, archetype in (*robot.draw_pose(solved.samples[number].q), *_draw_sample(solved, number)):
            stream.log(entity, archetype)
    stream.flush(timeout_sec=30.0)
    stream.disconnect()


def _blueprint() -> rrb.Blueprint:
    scene = rrb.Spatial3DView(
        origin=blueprint.WORLD,
        name="Arm, board and cameras",
        eye_controls=rrb.EyeControls3D(position=(0.9, -0.9, 0.7), look_target=(0.3, 0.0, 0.1), eye_up=(0.0, 0.0, 1.0)),
    )
    image = rrb.Spatial2DView(origin=blueprint.CAMERA, name="Corners: detected (green), expected by the result (red)")
    side = rrb.Vertical(
        image,
        rrb.TimeSeriesView(origin=RESIDUAL, name="Reprojection error [px]"),
        rrb.TextLogView(origin=blueprint.LOG, name="Samples"),
        row_shares=[3, 1, 1],
    )
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[1, 1]),
        rrb.TimePanel(timeline=TIMELINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _draw_board(solved: SolvedSamples) -> Drawing:
    width_m, height_m = solved.board.size_m
    outline = np.array([(0, 0, 0), (width_m, 0, 0), (width_m, height_m, 0), (0, height_m, 0), (0, 0, 0)])
    yield (
        f"{BOARD}/outline",
        rr.LineStrips3D([transform_points(solved.result.T_base_board, outline)], colors=_DETECTED, radii=0.001),
    )
    corners = transform_points(solved.result.T_base_board, solved.board.corners_m)
    yield f"{BOARD}/corners", rr.Points3D(corners, colors=_DETECTED, radii=0.002)


def _draw_cameras(solved: SolvedSamples) -> Drawing:
    for name, sample in zip(solved.names, solved.samples, strict=True):
        colour = _DROPPED if name in solved.result.dropped else _DETECTED
        place = f"{CAMERAS}/{name}"
        yield from _camera_at(
            place, sample.T_base_flange @ solved.result.T_flange_camera, solved.camera, _SMALL_FRUSTUM_M
        )
        yield f"{place}/name", rr.Points3D([[0.0, 0.0, 0.0]], labels=[name], colors=colour, radii=0.002)


def _camera_at(place: str, T_base_camera: np.ndarray, camera: CameraModel, plane_m: float) -> Drawing:
    yield place, rr.Transform3D(translation=T_base_camera[:3, 3], mat3x3=T_base_camera[:3, :3])
    yield (
        place,
        rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=list(camera.size),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=plane_m,
        ),
    )


def _draw_sample(solved: SolvedSamples, number: int) -> Drawing:
    name, sample, view = solved.names[number], solved.samples[number], solved.views[number]
    yield from _camera_at(
        blueprint.CAMERA, sample.T_base_flange @ solved.result.T_flange_camera, solved.camera, _FRUSTUM_M
    )
    _, png = cv2.imencode(
        ".png", np.ascontiguousarray(sample.image[..., ::-1] if sample.image.ndim == 3 else sample.image)
    )
    yield blueprint.COLOUR, rr.EncodedImage(contents=png.tobytes(), media_type="image/png")
    T_camera_board = inverse(sample.T_base_flange @ solved.result.T_flange_camera) @ solved.result.T_base_board
    expected = solved.camera.project(transform_points(T_camera_board, solved.board.corners_m[view.ids]))
    for name_2d, points, colour in (("expected", expected, _EXPECTED), ("detected", view.pixels_px, _DETECTED)):
        # Whole numbers are the corners of pixels in Rerun, their centres in OpenCV
        yield f"{blueprint.COLOUR}/{name_2d}", rr.Points2D(points + 0.5, colors=colour, radii=1.0)
    text = f"{name}: {len(view.ids)} corners"
    for stage, errors_px in (("before", solved.result.initial_px), ("after", solved.result.residuals_px)):
        if errors_px is not None:
            yield f"{RESIDUAL}/{stage}", rr.Scalars([errors_px[number]])
            text += f", {errors_px[number]:.3f} px {stage} the refinement"
    if name in solved.result.dropped:
        text += f"; left out: {solved.result.dropped[name]}"
    yield blueprint.LOG, rr.TextLog(text, level="WARN" if name in solved.result.dropped else "INFO")

"""Entity paths of a Rerun recording, and the layout of its viewer."""

from __future__ import annotations

import rerun.blueprint as rrb

TIMELINE = "time"

WORLD = "world"
ARM = "world/arm"
CAMERA = "world/camera"
COLOUR = "world/camera/colour"
DEPTH = "world/camera/depth"
SCENE = "world/scene"
OBJECT = "world/object"
OBSTACLES = "world/planning_scene/obstacles"
OCCLUDED = "world/planning_scene/occluded"
BOX = "world/box"
BOX_FACES = "world/box_faces"
CANDIDATES = "world/candidates"
GRASP = "world/plan/grasp"
PATH = "world/plan/path"
POSITION = "joints/position"
COMMAND = "joints/command"
TORQUE = "joints/torque"
PHASE = "states/phase"
SERVO = "states/servo"
STAGES = "stage_times"
LOG = "log"


def make_blueprint() -> rrb.Blueprint:
    """Return the layout: scene, both images, joints against command, phases, stage times and log at once."""
    scene = rrb.Spatial3DView(
        origin=WORLD,
        contents=["$origin/**", f"- {DEPTH}"],  # as a second cloud it would cover the object's
        name="Scene",
        eye_controls=rrb.EyeControls3D(position=(0.9, -0.9, 0.7), look_target=(0.3, 0.0, 0.2), eye_up=(0.0, 0.0, 1.0)),
    )
    images = rrb.Horizontal(
        rrb.Spatial2DView(origin=CAMERA, contents=COLOUR, name="Colour"),
        rrb.Spatial2DView(origin=CAMERA, contents=DEPTH, name="Depth"),
    )
    plots = rrb.Tabs(
        rrb.TimeSeriesView(origin="joints", contents=[POSITION, COMMAND], name="Joints: measured and commanded [rad]"),
        rrb.TimeSeriesView(origin="joints", contents=TORQUE, name="Torque [Nm]"),
    )
    texts = rrb.Horizontal(
        rrb.TextDocumentView(origin=STAGES, name="Stage times [ms]"), rrb.TextLogView(origin=LOG, name="Log")
    )
    lanes = rrb.StateTimelineView(origin="states", name="Phase and servo")
    side = rrb.Vertical(images, plots, lanes, texts, row_shares=[3, 3, 2, 2])
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),  # the panels leave the space to the scene
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )

"""One frame to clouds and table, on analytic scenes with a D405's errors; and its errors."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse, transform_points
from models.types import Detection
from tests.support.errors import raises
from tests.support.tabletop_scene import INTRINSICS, Box, Cylinder, T_base_camera, cast, frame_of, noisy_frame, truth
from z1_runtime.perception.detector import NoDepthError, NoDetectionError, PerceptionError, SmallCloudError, mask_box
from z1_runtime.perception.detectors.ground_truth import GroundTruthDetector
from z1_runtime.perception.detectors.tabletop import TabletopDetector
from z1_runtime.perception.point_cloud import back_project
from z1_runtime.perception.segmentation import Perception, PerceptionConfig

BOTTLE = Cylinder(0.5, 0.05, 0.0325, 0.2)
BOX = Box(0.45, -0.05, (0.06, 0.1, 0.18), 0.4)
JAW = -1.0
T_BASE_FLANGE = T_base_camera() @ inverse(z1.T_FLANGE_CAMERA)


def make(detector=None, **config):
    return Perception(PerceptionConfig(**config), detector or TabletopDetector())


def filtered(frame):
    return make().filter_self(frame, JAW)


def surface(objects, target=0):
    """Return the exact points of the visible surface of one object."""
    depth, which = cast(objects)
    return back_project(depth, INTRINSICS, which == target)


class Fixed:
    """Detector with fixed detections."""

    classes = ("bottle", "cup")
    min_confidence = 0.5

    def __init__(self, *detections):
        self._detections = list(detections)

    def detect(self, frame, T_base_camera):
        return self._detections


@pytest.mark.integration
@pytest.mark.parametrize("detector", [TabletopDetector(), GroundTruthDetector()])
@pytest.mark.parametrize("target", [BOTTLE, BOX, Cylinder(0.56, 0.15, 0.0325, 0.2)])
def test_the_objects_cloud_covers_the_object_and_nothing_else(target, detector):
    seen = make(detector).observe(noisy_frame([target]), T_BASE_FLANGE, JAW)
    exact = surface([target])
    assert 1000 < len(seen.object_points) <= 5000
    # 3σ of the depth noise at 0.5 m is 9 mm; nothing of the table, no flying pixel hangs behind.
    assert KDTree(exact).query(seen.object_points)[0].max() < 0.01
    assert (KDTree(seen.object_points).query(exact)[0] < 0.006).mean() >= 0.9


@pytest.mark.integration
def test_the_objects_cloud_holds_no_table():
    seen = make().observe(noisy_frame([BOX]), T_BASE_FLANGE, JAW)
    heights = transform_points(T_base_camera(), seen.object_points)[:, 2]
    assert heights.min() > 0.004
    assert heights.min() < 0.010  # nor is more cut off than the noise asks for
    assert heights.max() == pytest.approx(0.18, abs=0.008)


@pytest.mark.integration
def test_a_box_without_a_mask_gives_the_object_too_and_leaves_its_table_in_the_scene():
    frame = noisy_frame([BOX])
    by_mask = make(GroundTruthDetector()).observe(frame, T_BASE_FLANGE, JAW)
    detection = Detection(label="box", confidence=0.8, box_px=mask_box(truth(frame)))
    by_box = make().segment(filtered(frame), T_base_camera(), detection)
    exact = surface([BOX])
    assert KDTree(exact).query(by_box.object_points)[0].max() < 0.01
    assert (KDTree(by_box.object_points).query(exact)[0] < 0.006).mean() >= 0.9
    assert len(by_box.scene_points) == pytest.approx(len(by_mask.scene_points), rel=0.01)


@pytest.mark.integration
def test_the_scene_is_the_rest_at_full_resolution():
    scene = [BOTTLE, Box(0.56, -0.12, (0.05, 0.05, 0.1))]
    frame = noisy_frame(scene)
    seen = make().observe(frame, T_BASE_FLANGE, JAW)
    neighbour = surface(scene, 1)
    assert (KDTree(seen.scene_points).query(neighbour)[0] < 0.005).mean() > 0.9
    measured = ((frame.depth_m > 0) & (frame.depth_m <= 1.0)).sum()
    assert 0.9 * measured < len(seen.scene_points) + truth(frame).sum() < 1.05 * measured


@pytest.mark.integration
def test_no_scene_point_hangs_around_the_object():
    seen = make().observe(noisy_frame([BOTTLE]), T_BASE_FLANGE, JAW)
    p_base = transform_points(T_base_camera(), seen.scene_points)
    around = np.hypot(p_base[:, 0] - BOTTLE.x, p_base[:, 1] - BOTTLE.y) < 0.08
    assert (p_base[around, 2] > 0.015).sum() <= 5


@pytest.mark.integration
def test_the_table_comes_in_the_camera_frame():
    seen = make().observe(noisy_frame([BOTTLE]), T_BASE_FLANGE, JAW)
    T = T_base_camera()
    np.testing.assert_allclose(T[:3, :3] @ seen.table.normal, [0, 0, 1], atol=np.deg2rad(0.3))
    assert seen.table.height_m(np.zeros((1, 3)))[0] == pytest.approx(T[2, 3], abs=0.001)


@pytest.mark.integration
def test_observe_is_detect_and_then_segment_bit_by_bit():
    frame, perception = noisy_frame([BOTTLE]), make()
    whole = perception.observe(frame, T_BASE_FLANGE, JAW)
    frame = perception.filter_self(frame, JAW)
    T = T_BASE_FLANGE @ frame.T_flange_camera
    parts = perception.segment(frame, T, perception.detect(frame, T))
    assert whole.object_points.tobytes() == parts.object_points.tobytes()
    assert whole.scene_points.tobytes() == parts.scene_points.tobytes()
    assert whole.table.normal.tobytes() == parts.table.normal.tobytes()


def test_the_wanted_class_is_taken_even_when_another_is_surer():
    frame = noisy_frame([BOTTLE])
    cup = Detection(label="cup", confidence=0.9, box_px=(0, 0, 10, 10))
    bottle = Detection(label="bottle", confidence=0.6, box_px=mask_box(truth(frame)))
    perception = make(Fixed(cup, bottle))
    assert perception.detect(filtered(frame), T_base_camera()) is cup
    assert perception.detect(filtered(frame), T_base_camera(), "bottle") is bottle


def test_a_detector_without_classes_takes_any_label():
    assert make().detect(filtered(noisy_frame([BOTTLE])), T_base_camera(), "bottle").confidence > 0.5


def test_nothing_on_the_table_is_an_error_that_says_what_to_do():
    with raises(NoDetectionError, "no_detection") as caught:
        make().observe(noisy_frame([]), T_BASE_FLANGE, JAW)
    assert "TabletopDetector found no object. Put the object 0.40 to 0.56 m" in str(caught.value)


def test_only_other_classes_is_an_error_that_names_them():
    cup = Detection(label="cup", confidence=0.9, box_px=(0, 0, 10, 10))
    with raises(NoDetectionError, "no_detection") as caught:
        make(Fixed(cup)).detect(filtered(noisy_frame([BOTTLE])), T_base_camera(), "bottle")
    assert "cup 0.90" in str(caught.value)


def test_a_faint_detection_does_not_count_but_is_named():
    faint = Detection(label="bottle", confidence=0.31, box_px=(0, 0, 10, 10))
    with raises(NoDetectionError, "no_detection") as caught:
        make(Fixed(faint)).detect(filtered(noisy_frame([BOTTLE])), T_base_camera(), "bottle")
    assert "bottle 0.31" in str(caught.value)


def test_a_class_that_the_detector_does_not_know_is_rejected():
    with pytest.raises(InvalidValueError):
        make(Fixed()).detect(filtered(noisy_frame([BOTTLE])), T_base_camera(), "box")


@pytest.mark.integration
def test_the_crop_may_be_the_box_as_in_the_paper():
    frame = noisy_frame([BOTTLE])
    mask = truth(frame).copy()
    box = mask_box(mask)
    mask[: (box[1] + box[3]) // 2] = False  # the lower half only
    half = Fixed(Detection(label="bottle", confidence=0.9, box_px=box, mask=mask))
    by_mask, by_box = (
        Perception(PerceptionConfig(crop=crop), half).observe(frame, T_BASE_FLANGE, JAW) for crop in ("mask", "box")
    )
    assert np.ptp(by_box.object_points[:, 1]) > 1.6 * np.ptp(by_mask.object_points[:, 1])


def test_an_unknown_crop_is_rejected():
    with raises(InvalidValueError, "crop"):
        PerceptionConfig(crop="circle")


def test_an_empty_depth_image_is_an_error_in_both_steps():
    frame = frame_of(np.zeros((480, 640), np.float32))
    detection = Detection(label="object", confidence=1.0, box_px=(100, 100, 200, 200))
    with raises(NoDepthError, "no_depth"):
        make().detect(filtered(frame), T_base_camera())
    with raises(NoDepthError, "no_depth"):
        make().segment(filtered(frame), T_base_camera(), detection)


def test_too_few_points_are_an_error_that_counts_each_stage():
    frame = noisy_frame([BOTTLE])
    on_the_table = Detection(label="object", confidence=1.0, box_px=(60, 380, 100, 420))
    with raises(SmallCloudError, "small_cloud") as caught:
        make().segment(filtered(frame), T_base_camera(), on_the_table)
    assert all(word in str(caught.value) for word in ("100 are needed", "crop", "depth clip", "table removed"))
    outside = Detection(label="object", confidence=1.0, box_px=(700, 500, 720, 520))
    with raises(SmallCloudError, "small_cloud") as empty:
        make().segment(filtered(frame), T_base_camera(), outside)
    assert "crop 0" in str(empty.value)


def test_every_error_is_a_perception_error():
    for error in (NoDepthError, NoDetectionError, SmallCloudError):
        assert issubclass(error, PerceptionError)
    assert issubclass(PerceptionError, RuntimeError)


@pytest.mark.integration
def test_without_voxels_the_cloud_holds_measured_points_only():
    frame = noisy_frame([BOTTLE])
    seen = make(voxel_m=0.0).observe(frame, T_BASE_FLANGE, JAW)
    measured = back_project(frame.depth_m, INTRINSICS, frame.depth_m > 0)
    assert KDTree(measured).query(seen.object_points)[0].max() == 0.0


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"clip_percent": (99.0, 1.0)}, "clip_percent"),
        ({"d_max_m": float("nan")}, "d_max_m"),
        ({"voxel_m": -0.001}, "voxel_m"),
        ({"min_points": 0}, "min_points"),
    ],
)
def test_an_invalid_configuration_is_rejected(wrong, code):
    with raises(InvalidValueError, code):
        PerceptionConfig(**wrong)

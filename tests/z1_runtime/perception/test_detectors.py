"""The detectors on analytic scenes with a D405's errors."""

import cv2
import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from models.detector.detector import YoloConfig
from models.types import Detection
from models.weights_file import WeightsError
from tests.support.errors import raises
from tests.support.tabletop_scene import (
    INTRINSICS,
    Box,
    Cylinder,
    T_base_camera,
    cast,
    d405,
    frame_of,
    noisy_frame,
    truth,
)
from z1_runtime.perception.detector import NoTableError, PerceptionError, make_detector, mask_box
from z1_runtime.perception.detectors import yolo as yolo_detector
from z1_runtime.perception.detectors.ground_truth import GroundTruthDetector
from z1_runtime.perception.detectors.tabletop import TabletopDetector

BOTTLE = Cylinder(0.5, 0.0, 0.0325, 0.2)


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "target",
    [
        BOTTLE,
        Cylinder(0.4, 0.0, 0.0325, 0.2),
        Cylinder(0.56, 0.15, 0.0325, 0.2),
        Box(0.45, -0.1, (0.06, 0.1, 0.18), 0.4),
        Box(0.5, 0.05, (0.2, 0.06, 0.06), 0.8),
        Box(0.45, 0.0, (0.06, 0.1, 0.03), 1.2),
    ],
)
def test_an_object_is_found_as_one_with_a_mask_that_fits(target, seed):
    frame = noisy_frame([target], seed)
    found = TabletopDetector().detect(frame, T_base_camera())
    assert len(found) == 1
    mask = found[0].mask
    assert mask is not None
    assert iou(mask, truth(frame)) >= 0.9
    assert found[0].box_px == mask_box(mask)


@pytest.mark.parametrize(("tilt_rad", "lift_m"), [(0.02, 0.0), (-0.03, -0.01), (0.0, 0.02)])
def test_a_table_that_is_not_quite_where_it_should_be_changes_nothing(tilt_rad, lift_m):
    target = Box(0.45, 0.0, (0.06, 0.1, 0.18), 0.4, bottom_m=lift_m + 0.45 * np.tan(tilt_rad))
    frame = noisy_frame([target], tilt_rad=tilt_rad, lift_m=lift_m)
    found = TabletopDetector().detect(frame, T_base_camera())
    assert len(found) == 1
    assert iou(found[0].mask, truth(frame)) >= 0.9


def test_a_horizontal_gap_in_the_depth_does_not_cut_an_object_in_two():
    depth, which = cast([BOTTLE])
    noisy = d405(depth, 0)
    top, bottom = mask_box(which == 0)[1::2]
    middle = (top + bottom) // 2
    noisy[middle - 12 : middle + 12] = 0.0
    found = TabletopDetector().detect(frame_of(noisy), T_base_camera())
    assert len(found) == 1
    assert found[0].box_px[3] - found[0].box_px[1] > 0.9 * (bottom - top)


def test_holes_inside_an_object_are_filled_in_its_mask():
    depth, which = cast([BOTTLE])
    noisy = d405(depth, 0)
    hole = which == 0
    u_min, v_min, u_max, v_max = mask_box(hole)
    v, u = (v_min + v_max) // 2, (u_min + u_max) // 2
    noisy[v - 5 : v + 5, u - 5 : u + 5] = 0.0
    found = TabletopDetector().detect(frame_of(noisy), T_base_camera())
    mask = found[0].mask
    assert mask is not None
    assert mask[v - 5 : v + 5, u - 5 : u + 5].all()


def test_two_objects_are_two_and_the_larger_comes_first():
    scene = [Box(0.5, 0.12, (0.05, 0.05, 0.06)), Cylinder(0.45, -0.05, 0.0325, 0.2)]
    frame = noisy_frame(scene, target=1)
    found = TabletopDetector().detect(frame, T_base_camera())
    assert len(found) == 2
    assert found[0].confidence > found[1].confidence
    assert iou(found[0].mask, truth(frame)) >= 0.9


@pytest.mark.integration
def test_one_object_half_behind_another_stays_apart():
    scene = [Cylinder(0.42, 0.0, 0.03, 0.1), Cylinder(0.56, 0.02, 0.0325, 0.2)]
    depth, which = cast(scene)
    found = TabletopDetector().detect(frame_of(d405(depth, 0)), T_base_camera())
    assert len(found) == 2
    best = [max(iou(d.mask, which == i) for d in found) for i in (0, 1)]
    assert min(best) >= 0.8


def test_an_object_cut_by_the_image_border_comes_last():
    scene = [Cylinder(0.45, 0.0, 0.03, 0.12), Box(0.45, 0.27, (0.1, 0.1, 0.2))]
    frame = noisy_frame(scene)
    found = TabletopDetector().detect(frame, T_base_camera())
    assert len(found) == 2
    assert iou(found[0].mask, truth(frame)) >= 0.9


def test_objects_outside_the_workspace_are_not_reported():
    assert TabletopDetector().detect(noisy_frame([Box(0.85, 0.0, (0.1, 0.5, 0.3))]), T_base_camera()) == []


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_an_empty_table_is_not_an_object(seed):
    assert TabletopDetector().detect(noisy_frame([], seed), T_base_camera()) == []


def test_without_a_table_in_view_the_error_says_so():
    depth = np.full((INTRINSICS.height, INTRINSICS.width), 0.1, np.float32)
    with raises(NoTableError, "no_table"):
        TabletopDetector().detect(frame_of(depth), T_base_camera())


def test_detection_repeats_bit_by_bit():
    frame = noisy_frame([BOTTLE])
    first, second = (TabletopDetector().detect(frame, T_base_camera())[0] for _ in range(2))
    assert (first.mask == second.mask).all()
    assert first.confidence == second.confidence


def test_the_ground_truth_detector_returns_the_mask():
    frame = noisy_frame([BOTTLE])
    (found,) = GroundTruthDetector().detect(frame, T_base_camera())
    assert (found.mask == truth(frame)).all()
    assert found.confidence == 1.0


def test_the_ground_truth_detector_finds_nothing_when_the_object_is_out_of_view():
    frame = frame_of(d405(cast([])[0], 0), np.zeros((480, 640), bool))
    assert GroundTruthDetector().detect(frame, T_base_camera()) == []


def test_the_ground_truth_detector_fails_without_a_mask():
    frame = frame_of(d405(cast([])[0], 0))
    with raises(PerceptionError, "no_ground_truth"):
        GroundTruthDetector().detect(frame, T_base_camera())


def test_detectors_are_made_by_name():
    assert isinstance(make_detector("tabletop"), TabletopDetector)
    assert isinstance(make_detector("ground_truth"), GroundTruthDetector)
    with raises(InvalidValueError, "unknown_detector"):
        make_detector("yolo9000")


class FakeYoloModel:
    """Stand-in for the network with fixed detections."""

    classes = ("bottle",)
    runtime = "none"

    def __init__(self, config):
        self.config = config or YoloConfig()
        self.detections = []

    def detect(self, image, min_confidence):
        assert image.dtype == np.uint8
        return [d for d in self.detections if d.confidence > min_confidence]


@pytest.fixture
def yolo(monkeypatch):
    monkeypatch.setattr(yolo_detector, "YoloModel", FakeYoloModel)
    return make_detector("yolo", YoloConfig(min_confidence=0.6))


def test_the_learned_detector_reports_faint_detections_too(yolo):
    yolo._detector.detections = [Detection(label="bottle", confidence=c, box_px=(0, 0, 9, 9)) for c in (0.9, 0.3, 0.05)]
    found = yolo.detect(noisy_frame([BOTTLE]), T_base_camera())
    assert [d.confidence for d in found] == [0.9, 0.3]
    assert (yolo.classes, yolo.min_confidence) == (("bottle",), 0.6)


def test_the_background_at_the_edge_of_a_mask_is_taken_off(yolo):
    frame = noisy_frame([BOTTLE])
    true = truth(frame)
    sloppy = cv2.dilate(true.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    yolo._detector.detections = [Detection(label="bottle", confidence=0.9, box_px=mask_box(sloppy), mask=sloppy)]
    (found,) = yolo.detect(frame, T_base_camera())
    extra = sloppy & ~true & (frame.depth_m > 0)
    assert (found.mask & extra).sum() < 0.6 * extra.sum()
    assert (found.mask & true).sum() > 0.97 * true.sum()
    assert (found.mask[sloppy & (frame.depth_m == 0)]).all()  # holes stay


def test_a_mask_without_an_inside_or_without_depth_stays_as_it_is(yolo):
    line = np.zeros((480, 640), bool)
    line[100:103, 100:300] = True
    yolo._detector.detections = [Detection(label="bottle", confidence=0.9, box_px=mask_box(line), mask=line)]
    (found,) = yolo.detect(noisy_frame([BOTTLE]), T_base_camera())
    assert (found.mask == line).all()


def test_a_pattern_on_the_table_is_rejected_with_a_warning(yolo, caplog):
    pattern = np.zeros((480, 640), bool)
    pattern[330:410, 420:540] = True
    frame = noisy_frame([BOTTLE])
    yolo._detector.detections = [
        Detection(label="bottle", confidence=0.9, box_px=mask_box(mask), mask=mask) for mask in (pattern, truth(frame))
    ]
    (found,) = yolo.detect(frame, T_base_camera())
    assert iou(found.mask, truth(frame)) > 0.9
    assert "the bottle (confidence 0.90) is in the plane of its surroundings" in caplog.text


def test_missing_weights_of_the_learned_detector_name_the_file_and_what_makes_it(tmp_path):
    with pytest.raises(WeightsError) as caught:
        make_detector("yolo", YoloConfig(weights=tmp_path / "mine.npz"))
    assert "mine.npz" in str(caught.value) and "--detector tabletop" in str(caught.value)

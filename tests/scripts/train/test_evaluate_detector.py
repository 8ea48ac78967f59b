"""Evaluation of the detector: a perfect one scores 1, and each kind of mistake lowers a figure."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from models.types import Detection
from scripts.train.evaluate_detector import label_file, measure_empty, measure_held_out
from scripts.train.make_detection_dataset import read_labels, to_line
from sim_twin.detection_data.scenes import Label

SHAPE = (480, 640)


def rectangle(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[top:bottom, left:right] = True
    return mask


def detection(name: str, mask: np.ndarray, confidence: float) -> Detection:
    left, top, right, bottom = (int(side) for side in Label(name=name, mask=mask).box())
    return Detection(label=name, confidence=confidence, box_px=(left, top, right, bottom), mask=mask)


class Oracle:
    """Detector that gives the labels of the picture with a given brightness, changed by `corrupt`."""

    def __init__(self, data: Path, corrupt: Callable[[list[Detection]], list[Detection]]) -> None:
        self.config = SimpleNamespace(min_confidence=0.5)
        self._files = sorted((data / "images/val").glob("*/*.jpg"))
        self._corrupt = corrupt

    def detect(self, image: np.ndarray, min_confidence: float | None = None) -> list[Detection]:
        labels = read_labels(label_file(self._files[round(float(image.mean()) / 20) - 1]), SHAPE)
        return self._corrupt([detection(label.name, label.mask, 0.9 - 0.1 * k) for k, label in enumerate(labels)])


@pytest.fixture
def data(tmp_path: Path) -> Path:
    labels = [
        [Label(name="bottle", mask=rectangle(50, 50, 150, 300)), Label(name="box", mask=rectangle(300, 100, 400, 200))],
        [Label(name="cylinder", mask=rectangle(200, 200, 300, 400))],
        [Label(name="bottle", mask=rectangle(500, 60, 600, 200))],
    ]
    for number, (look, objects) in enumerate(zip(("twin", "own", "any"), labels, strict=True)):
        name = f"{number}_{look}"
        image, file = tmp_path / f"images/val/1/{name}.jpg", tmp_path / f"labels/val/1/{name}.txt"
        for path in (image, file):
            path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(image), np.full((*SHAPE, 3), 20 * (number + 1), np.uint8))
        file.write_text("".join(to_line(label) + "\n" for label in objects))
    return tmp_path


def measure(data: Path, corrupt: Callable[[list[Detection]], list[Detection]]) -> dict[str, object]:
    oracle = Oracle(data, corrupt)
    return measure_held_out(oracle, oracle, data, 500)  # pyright: ignore[reportArgumentType]


def test_a_perfect_detector_has_maximum_figures(data: Path) -> None:
    figures = measure(data, lambda found: found)
    assert figures["box_map50"] == pytest.approx(0.995, abs=0.001)  # 101 points between recalls 0 and 1
    assert figures["mask_map50_95"] == pytest.approx(0.995, abs=0.001)
    assert figures["precision"] == figures["recall"] == 1.0
    assert (figures["held_out_pictures"], figures["held_out_objects"]) == (3, 4)


def test_wrong_names_and_incomplete_masks_lower_the_figures(data: Path) -> None:
    def rename(found: list[Detection]) -> list[Detection]:
        return [replace(d, label="box") if d.label == "cylinder" else d for d in found]

    def thin(found: list[Detection]) -> list[Detection]:
        return [replace(d, mask=rectangle(*d.box_px[:2], d.box_px[0] + 60, d.box_px[3])) for d in found]

    renamed = measure(data, rename)
    assert float(str(renamed["box_map50"])) < 0.7
    assert renamed["box_map50_by_look"] == {"any": 0.995, "own": 0.0, "twin": 0.995}
    thinned = measure(data, thin)
    assert thinned["box_map50_95"] == pytest.approx(0.995, abs=0.001)
    assert float(str(thinned["mask_map50_95"])) < 0.4


def test_a_box_in_an_empty_picture_is_counted_only_above_the_threshold(data: Path) -> None:
    (data / "images/val").rename(data / "images/empty")
    mask = rectangle(10, 10, 50, 50)
    replies = iter([[detection("box", mask, 0.6)], [detection("box", mask, 0.3)], []])
    detector = SimpleNamespace(config=SimpleNamespace(min_confidence=0.5), detect=lambda image, minimum: next(replies))
    figures = measure_empty(detector, data)  # pyright: ignore[reportArgumentType]
    assert (figures["empty_pictures"], figures["empty_with_false_box"]) == (3, 1)
    assert figures["empty_highest_confidence"] == 0.6

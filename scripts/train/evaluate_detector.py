"""Evaluate the detector on held-out pictures and on the 81 scenario views; writes `models/weights/detector.json`.

    nice -n 10 python -m scripts.train.evaluate_detector                  # a minute on two cores
    python -m scripts.train.evaluate_detector --weights some.npz --out out/detector/some.json

Held-out pictures come from `make_detection_dataset`: other seeds, so other props, textures and lights. A picture of the
detections is written next to the figures.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from hal.base import z1
from hal.base.clock import Stopwatch
from hal.base.errors import MissingFileError
from models.detector.detector import YoloConfig, YoloModel, best_of, labels_for
from models.detector.metrics import MatchedDetections, mask_iou, match_detections
from models.detector.weights import detector_path
from models.types import Detection
from scripts.train.make_detection_dataset import read_labels
from sim_twin.benchmark.episodes.scenarios import PAPER_OBJECTS, Scenario, grid
from sim_twin.camera.d405 import INTRINSICS, measure_colour
from sim_twin.detection_data.props import CLASSES
from sim_twin.detection_data.scenes import Appearance, Label, LabelledImage, draw_scenario

TARGETS = {
    "box_map50": 0.97,
    "mask_map50_95": 0.75,
    "empty_with_false_box": 0,
    "views_twin": 81,
    "median_ms": 40.0,
}
"""Targets of the figures; those of errors and time are maxima."""
VIEW_IOU = 0.8
_MIN_CONFIDENCE, _MAX_DETECTIONS = 0.001, 300
"""Limits of the average precision, with every class of a box: those of ultralytics' validator."""
_JAW_RAD = -1.0  # `RuntimeConfig.jaw_home`
_STAGE_SEED = 4_000_000  # outside of `make_detection_dataset.SPLITS`
_COLOURS = {"bottle": (255, 60, 255), "box": (60, 230, 60), "cylinder": (255, 80, 60)}


@dataclass(frozen=True, kw_only=True)
class Config:
    """Detector, data and extent of the evaluation."""

    weights: Path | None = None
    """A weights file of `models.detector.detector`; by default the shipped one."""
    runtime: str = "auto"
    """One of `models.detector.detector`'s runtimes."""
    data: Path = Path("out/detector/data")
    """Folder of `make_detection_dataset`."""
    pictures: int = 500
    """Maximum number of held-out pictures."""
    repeats: int = 100
    """Pictures over which the latency is measured."""
    out: Path | None = None
    """File of the figures; next to the weights by default."""


def main(config: Config) -> None:
    """Evaluate the detector, print and write the figures."""
    detector = YoloModel(YoloConfig(weights=config.weights, runtime=config.runtime))
    figures = {"runtime": detector.runtime, "min_confidence": detector.config.min_confidence}
    exhaustive = YoloModel(replace(detector.config, every_class=True, max_detections=_MAX_DETECTIONS))
    figures |= measure_held_out(detector, exhaustive, config.data, config.pictures)
    figures |= measure_empty(detector, config.data)
    tiles = []
    for look in get_args(Appearance):
        views = measure_views(detector, draw_twin_views() if look == "twin" else draw_varied_views(look), look)
        figures |= views.figures
        tiles += views.tiles
    figures |= measure_time(detector, config.repeats)
    out = config.out or (config.weights or detector_path()).with_suffix(".json")
    out.write_text(json.dumps(figures, indent=1) + "\n")
    write_sheet(detector, config.data, tiles, out.with_suffix(".jpg"))
    Console().print(_table(figures))


def measure_held_out(detector: YoloModel, exhaustive: YoloModel, data: Path, pictures: int) -> dict[str, object]:
    """Return mean average precision of boxes and masks over the held-out pictures, of all and by appearance.

    Args:
        detector: in its normal configuration, for precision and recall.
        exhaustive: the same with every class of a box, for the average precision.
        data: folder of the pictures.
        pictures: maximum number of them.
    """
    by_look: dict[str, MatchedDetections] = {}
    counts = [0, 0, 0]  # at the default threshold: true positives, detections, labels
    images = _list_images(data, "val")[:pictures]
    for image in track(images, description="held-out pictures"):
        colour = read_image(image)
        labels = read_labels(label_file(image), colour.shape[:2])
        found = exhaustive.detect(colour, _MIN_CONFIDENCE)
        by_box, by_mask = match_detections(found, labels)
        matched = by_look.setdefault(image.stem.partition("_")[2], MatchedDetections())
        numbers = [CLASSES.index(detection.label) for detection in found]
        matched.rows += list(zip(by_box, by_mask, [d.confidence for d in found], numbers, strict=True))
        matched.targets += [CLASSES.index(label.name) for label in labels]
        hits, _ = match_detections(normal := detector.detect(colour), labels)
        counts = [a + int(b) for a, b in zip(counts, (hits[:, 0].sum(), len(normal), len(labels)), strict=True)]
    together = MatchedDetections(
        rows=[row for matched in by_look.values() for row in matched.rows],
        targets=[number for matched in by_look.values() for number in matched.targets],
    )
    figures: dict[str, object] = {"held_out_pictures": len(images), "held_out_objects": len(together.targets)}
    for name, column in (("box", 0), ("mask", 1)):
        precision = together.average_precision(column)
        figures[f"{name}_map50"], figures[f"{name}_map50_95"] = _round(precision[:, 0].mean()), _round(precision.mean())
        figures[f"{name}_ap50_95"] = dict(zip(CLASSES, (_round(p) for p in precision.mean(axis=1)), strict=True))
        figures[f"{name}_map50_by_look"] = {
            look: _round(matched.average_precision(column)[:, 0].mean()) for look, matched in sorted(by_look.items())
        }
    right, found_count, label_count = counts
    figures["precision"], figures["recall"] = _round(right / max(found_count, 1)), _round(right / max(label_count, 1))
    return figures


def measure_empty(detector: YoloModel, data: Path) -> dict[str, object]:
    """Return the number of false boxes on pictures without objects, at the default threshold."""
    images = _list_images(data, "empty")
    highest = [max((d.confidence for d in detector.detect(read_image(i), 0.05)), default=0.0) for i in images]
    wrong = sum(confidence > detector.config.min_confidence for confidence in highest)
    return {
        "empty_pictures": len(images),
        "empty_with_false_box": int(wrong),
        "empty_highest_confidence": _round(max(highest)),
    }


def draw_twin_views() -> Iterator[tuple[Scenario, LabelledImage]]:
    """Yield the 81 scenarios in the twin's wrist camera at home, noise included."""
    import mujoco

    from sim_twin.camera.render import make_renderer
    from sim_twin.model.scene import SceneConfig
    from sim_twin.model.world import World

    for name in PAPER_OBJECTS:
        world = World(SceneConfig(object=name))
        renderer = make_renderer(world.model, INTRINSICS)
        data = world.snapshot()
        data.qpos[: z1.N_JOINTS] = np.append(z1.Q_HOME, _JAW_RAD)
        for scenario in grid([name]):
            pose = scenario.scene().T_base_object()
            quat = np.empty(4)
            mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel().copy())
            data.qpos[z1.N_JOINTS :] = [*pose[:3, 3], *quat]
            # Rendering needs poses and lights alone, without the dynamics of mj_forward.
            mujoco.mj_kinematics(world.model, data)
            mujoco.mj_comPos(world.model, data)
            mujoco.mj_camlight(world.model, data)
            view = renderer.render(data)
            colour = measure_colour(view.colour, scenario.draw_seed, 0)
            yield scenario, LabelledImage(colour=colour, labels=(Label(name=name, mask=view.mask),), appearance="twin")
        renderer.close()


def draw_varied_views(look: Appearance) -> Iterator[tuple[Scenario, LabelledImage]]:
    """Yield the same poses, each with a random room and camera."""
    from sim_twin.detection_data.scene_renderer import SceneRenderer

    renderer = SceneRenderer(_STAGE_SEED)
    for scenario in grid():
        rng = np.random.default_rng([_STAGE_SEED, scenario.draw_seed])
        yield (
            scenario,
            draw_scenario(
                renderer, scenario.object, scenario.scene().T_base_object(), rng, appearance=look, jaw_rad=_JAW_RAD
            ),
        )
    renderer.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewResults:
    """Figures of the scenario views, with pictures of some."""

    figures: dict[str, object]
    tiles: list[np.ndarray]
    """Some of the views, drawn on."""


def measure_views(detector: YoloModel, views: Iterator[tuple[Scenario, LabelledImage]], look: str) -> ViewResults:
    """Return the number of the 81 views in which the object is found with an IoU of at least 0.8, and the failures."""
    ious: dict[str, float] = {}
    tiles = []
    for number, (scenario, picture) in enumerate(track(views, description=f"views, {look}", total=81)):
        found = detector.detect(picture.colour)
        best = best_of(found, labels_for(scenario.object, detector.classes))
        mask = best.mask if best is not None else None
        ground_truth = picture.labels[0].mask if picture.labels else np.zeros(picture.colour.shape[:2], dtype=bool)
        ious[scenario.key] = 0.0 if mask is None else mask_iou(mask, ground_truth)
        if number % 27 == 13:  # the middle of each object's 27 poses
            tiles.append(draw_found(picture.colour, found))
    passed = sum(1 for iou in ious.values() if iou >= VIEW_IOU)
    failed = {key: _round(iou) for key, iou in ious.items() if iou < VIEW_IOU}
    median = _round(float(np.median(list(ious.values()))))
    figures = {f"views_{look}": passed, f"views_{look}_median_iou": median, f"views_{look}_failed": failed}
    return ViewResults(figures=figures, tiles=tiles)


def measure_time(detector: YoloModel, repeats: int) -> dict[str, object]:
    """Return the median latency at 640×480 [ms]."""
    image = next(draw_twin_views())[1].colour
    detector.detect(image)  # the first run loads and compiles
    times = []
    for _ in range(repeats):
        watch = Stopwatch()
        detector.detect(image)
        times.append(watch.lap_ms())
    return {"median_ms": round(float(np.median(times)), 1), "p90_ms": round(float(np.quantile(times, 0.9)), 1)}


def write_sheet(detector: YoloModel, data: Path, tiles: list[np.ndarray], path: Path) -> None:
    """Write a sheet of detections: some scenario views, then some held-out pictures."""
    images = _list_images(data, "val")
    # Ten, spread over the shards, which have different props.
    held_out = [read_image(image) for image in images[:: max(len(images) // 10, 1)][:10]]
    tiles = tiles + [draw_found(colour, detector.detect(colour)) for colour in held_out]
    small = [cv2.resize(tile, (320, 240), interpolation=cv2.INTER_AREA) for tile in tiles]
    rows = [np.hstack(small[start : start + 4]) for start in range(0, len(small) // 4 * 4, 4)]
    cv2.imwrite(str(path), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])


def draw_found(colour: np.ndarray, found: list[Detection]) -> np.ndarray:
    """Return `colour` with outlines, boxes and names."""
    drawn = colour.copy()
    for detection in found:
        shade = _COLOURS[detection.label]
        if detection.mask is not None:
            drawn[detection.mask] = (0.6 * drawn[detection.mask] + 0.4 * np.array(shade)).astype(np.uint8)
        left, top, right, bottom = detection.box_px
        cv2.rectangle(drawn, (left, top), (right, bottom), shade, 2)
        text = f"{detection.label} {detection.confidence:.2f}"
        cv2.putText(drawn, text, (left + 3, max(top - 6, 20)), cv2.FONT_HERSHEY_SIMPLEX, 0.7, shade, 2)
    return drawn


def read_image(path: Path) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 RGB."""
    image = cv2.imread(str(path))
    if image is None:
        raise MissingFileError(
            f"{path} is not a picture; make the data again with `python -m scripts.train.make_detection_dataset`.",
            code="no_picture",
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def label_file(image: Path) -> Path:
    """Return the path of the labels of `image`."""
    folder = image.parent
    return folder.parent.parent.parent / "labels" / folder.parent.name / folder.name / f"{image.stem}.txt"


def _list_images(data: Path, split: str) -> list[Path]:
    images = sorted((data / "images" / split).glob("*/*.jpg"))
    if not images:
        raise MissingFileError(
            f"{data} has no {split} pictures; make them with `python -m scripts.train.make_detection_dataset`.",
            code="no_data",
        )
    return images


def _table(figures: dict) -> Table:
    table = Table("figure", "measured", "target", title="Detector")
    for key, value in figures.items():
        target = TARGETS.get(key)
        table.add_row(key, str(value), "" if target is None else str(target))
    return table


def _round(value: float) -> float:
    return round(float(value), 4)


if __name__ == "__main__":
    main(tyro.cli(Config))

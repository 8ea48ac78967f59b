"""Measures the detector on held-out pictures and on the 81 scenario views; writes `models/weights/detector.json`.

    nice -n 10 python -m scripts.train.evaluate_detector                  # a minute on two cores
    python -m scripts.train.evaluate_detector --weights some.npz --out out/detector/some.json

Held-out pictures come from `make_detection_dataset`: other seeds, so other props, textures and lights. A picture with
what was found is written beside the figures.
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
from models.detector.detector import YoloConfig, YoloModel, labels_for, select_best
from models.detector.weights import detector_path
from models.types import Detection
from scripts.train.detection_measures import Tally, mask_iou, match
from scripts.train.make_detection_dataset import read_labels
from sim_twin.benchmark.episodes.scenarios import PAPER_OBJECTS, Scenario, grid
from sim_twin.camera.d405 import INTRINSICS, measure_colour
from sim_twin.detection_data.props import CLASSES
from sim_twin.detection_data.scenes import Appearance, Label, LabelledImage, draw_scenario

WANTED = {
    "box_map50": 0.97,
    "mask_map50_95": 0.75,
    "empty_with_false_box": 0,
    "views_twin": 81,
    "median_ms": 40.0,
}
"""What the detector shall reach; the last two: of 81 views, at most."""
VIEW_IOU = 0.8
_LOWEST_CONFIDENCE, _MOST_RANKED = 0.001, 300
"""What counts for the average precision, and with every class of a box: as ultralytics' validator has it."""
_JAW_RAD = -1.0
_STAGE_SEED = 4_000_000
_COLOURS = {"bottle": (255, 60, 255), "box": (60, 230, 60), "cylinder": (255, 80, 60)}


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to measure, and on what."""

    weights: Path | None = None
    """A file that `models.detector.detector` reads; the shipped one if not given."""
    runtime: str = "auto"
    """One of `models.detector.detector`'s runtimes."""
    data: Path = Path("out/detector/data")
    """Folder that `make_detection_dataset` wrote."""
    most: int = 500
    """Held-out pictures to look at."""
    repeats: int = 100
    """Pictures over which the time is measured."""
    out: Path | None = None
    """Where the figures go; beside the weights if not given."""


def main(config: Config) -> None:
    """Measure, print and write."""
    detector = YoloModel(YoloConfig(weights=config.weights, runtime=config.runtime))
    figures = {"runtime": detector.runtime, "min_confidence": detector.config.min_confidence}
    lavish = YoloModel(replace(detector.config, every_class=True, max_detections=_MOST_RANKED))
    figures |= measure_held_out(detector, lavish, config.data, config.most)
    figures |= measure_empty(detector, config.data)
    tiles = []
    for look in get_args(Appearance):
        seen = measure_views(detector, twin_views() if look == "twin" else spoilt_views(look), look)
        figures |= seen.figures
        tiles += seen.tiles
    figures |= measure_time(detector, config.repeats)
    out = config.out or (config.weights or detector_path()).with_suffix(".json")
    out.write_text(json.dumps(figures, indent=1) + "\n")
    write_sheet(detector, config.data, tiles, out.with_suffix(".jpg"))
    Console().print(_table(figures))


def measure_held_out(detector: YoloModel, lavish: YoloModel, data: Path, most: int) -> dict[str, object]:
    """Return mean average precision of boxes and masks over the held-out pictures, of all and by their look.

    Args:
        detector: as it is used; what it gives out makes precision and recall.
        lavish: the same, of which every class of a box counts; what it gives out makes the average precision.
        data: folder of the pictures.
        most: how many of them.
    """
    looks: dict[str, Tally] = {}
    good = [0, 0, 0]  # at the default threshold: found and right, found, there
    images = _images(data, "val")[:most]
    for image in track(images, description="held-out pictures"):
        colour = read_image(image)
        labels = read_labels(label_file(image), colour.shape[:2])
        found = lavish.detect(colour, _LOWEST_CONFIDENCE)
        by_box, by_mask = match(found, labels)
        tally = looks.setdefault(image.stem.partition("_")[2], Tally())
        numbers = [CLASSES.index(detection.label) for detection in found]
        tally.rows += list(zip(by_box, by_mask, [d.confidence for d in found], numbers, strict=True))
        tally.targets += [CLASSES.index(label.name) for label in labels]
        hits, _ = match(given := detector.detect(colour), labels)
        good = [a + int(b) for a, b in zip(good, (hits[:, 0].sum(), len(given), len(labels)), strict=True)]
    together = Tally(
        rows=[row for tally in looks.values() for row in tally.rows],
        targets=[number for tally in looks.values() for number in tally.targets],
    )
    figures: dict[str, object] = {"held_out_pictures": len(images), "held_out_objects": len(together.targets)}
    for name, column in (("box", 0), ("mask", 1)):
        precision = together.average_precision(column)
        figures[f"{name}_map50"], figures[f"{name}_map50_95"] = _round(precision[:, 0].mean()), _round(precision.mean())
        figures[f"{name}_ap50_95"] = dict(zip(CLASSES, (_round(p) for p in precision.mean(axis=1)), strict=True))
        figures[f"{name}_map50_by_look"] = {
            look: _round(tally.average_precision(column)[:, 0].mean()) for look, tally in sorted(looks.items())
        }
    figures["precision"], figures["recall"] = _round(good[0] / max(good[1], 1)), _round(good[0] / max(good[2], 1))
    return figures


def measure_empty(detector: YoloModel, data: Path) -> dict[str, object]:
    """Return how often something is seen where nothing is, at the default threshold."""
    images = _images(data, "empty")
    most = [max((d.confidence for d in detector.detect(read_image(i), 0.05)), default=0.0) for i in images]
    wrong = sum(confidence > detector.config.min_confidence for confidence in most)
    return {
        "empty_pictures": len(images),
        "empty_with_false_box": int(wrong),
        "empty_highest_confidence": _round(max(most)),
    }


def twin_views() -> Iterator[tuple[Scenario, LabelledImage]]:
    """Yield the 81 scenarios as the twin's wrist camera sees them from home, noise included."""
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
            mujoco.mj_kinematics(world.model, data)
            mujoco.mj_comPos(world.model, data)
            mujoco.mj_camlight(world.model, data)
            view = renderer.render(data)
            colour = measure_colour(view.colour, scenario.draw_seed, 0)
            yield scenario, LabelledImage(colour=colour, labels=(Label(name=name, mask=view.mask),), appearance="twin")
        renderer.close()


def spoilt_views(look: Appearance) -> Iterator[tuple[Scenario, LabelledImage]]:
    """Yield the same poses, each in a room and through a camera of its own."""
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
class Seen:
    """What came of looking at the scenario views."""

    figures: dict[str, object]
    tiles: list[np.ndarray]
    """Some of the views, drawn on."""


def measure_views(detector: YoloModel, views: Iterator[tuple[Scenario, LabelledImage]], look: str) -> Seen:
    """Return in how many of the 81 views the right object is found with an IoU of at least 0.8, and which fail."""
    ious: dict[str, float] = {}
    tiles = []
    for number, (scenario, picture) in enumerate(track(views, description=f"views, {look}", total=81)):
        found = detector.detect(picture.colour)
        best = select_best(found, labels_for(scenario.object, detector.classes))
        seen = best.mask if best is not None else None
        truth = picture.labels[0].mask if picture.labels else np.zeros(picture.colour.shape[:2], dtype=bool)
        ious[scenario.key] = 0.0 if seen is None else mask_iou(seen, truth)
        if number % 27 == 13:
            tiles.append(draw_found(picture.colour, found))
    passed = sum(1 for iou in ious.values() if iou >= VIEW_IOU)
    failed = {key: _round(iou) for key, iou in ious.items() if iou < VIEW_IOU}
    median = _round(float(np.median(list(ious.values()))))
    figures = {f"views_{look}": passed, f"views_{look}_median_iou": median, f"views_{look}_failed": failed}
    return Seen(figures=figures, tiles=tiles)


def measure_time(detector: YoloModel, repeats: int) -> dict[str, object]:
    """Return the median time of a look at 640×480 [ms]."""
    image = next(twin_views())[1].colour
    detector.detect(image)
    times = []
    for _ in range(repeats):
        watch = Stopwatch()
        detector.detect(image)
        times.append(watch.lap_ms())
    return {"median_ms": round(float(np.median(times)), 1), "p90_ms": round(float(np.quantile(times, 0.9)), 1)}


def write_sheet(detector: YoloModel, data: Path, tiles: list[np.ndarray], path: Path) -> None:
    """Write a sheet of what was found: some scenario views, then the first held-out pictures."""
    images = _images(data, "val")
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
            f"{path} is not a picture; make the data anew with scripts.train.make_detection_dataset."
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def label_file(image: Path) -> Path:
    """Return where the labels of `image` lie."""
    folder = image.parent
    return folder.parent.parent.parent / "labels" / folder.parent.name / folder.name / f"{image.stem}.txt"


def _images(data: Path, split: str) -> list[Path]:
    images = sorted((data / "images" / split).glob("*/*.jpg"))
    if not images:
        raise MissingFileError(
            f"{data} has no {split} pictures; make them with `python -m scripts.train.make_detection_dataset`."
        )
    return images


def _table(figures: dict) -> Table:
    table = Table("figure", "measured", "wanted", title="Detector")
    for key, value in figures.items():
        wanted = WANTED.get(key)
        table.add_row(key, str(value), "" if wanted is None else str(wanted))
    return table


def _round(value: float) -> float:
    return round(float(value), 4)


if __name__ == "__main__":
    main(tyro.cli(Config))

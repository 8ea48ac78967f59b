"""Make the detector's pictures: random scenes of the twin, with exact masks as polygons.

    python -m scripts.train.make_detection_dataset                # train, val and empty into out/detector/data
    python -m scripts.train.make_detection_dataset --jobs 2       # in two processes

Every shard of pictures has its own seed and props. Existing shards are kept, so an interrupted run resumes.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import tyro
from rich.progress import track

from sim_twin.detection_data.props import CLASSES
from sim_twin.detection_data.scenes import Label, LabelledImage, SceneMix

SPLITS = {"train": 1_000_000, "val": 2_000_000, "empty": 3_000_000}
"""Name to the first seed: no two splits share a seed, so neither props, textures nor lights."""

_CHANGES = {
    "train": {"crowd": 0.5, "empty": 0.1, "twin": 0.25, "own": 0.35, "distractors": 6.0},
    "empty": {"empty": 1.0},
}
"""Differences of the splits from the mix: training pictures hold more objects that can be confused."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Numbers of pictures, and their mix of scenes."""

    train: int = 20000
    """Training pictures."""
    val: int = 500
    """Held-out pictures."""
    empty: int = 100
    """Held-out pictures without any object."""
    shard: int = 100
    """Pictures that share their props; a shard is written atomically."""
    seed: int = 0
    """Added to every seed."""
    jobs: int = 1
    """Processes."""
    out: Path = Path("out/detector/data")
    """Folder for images and labels."""
    mix: SceneMix = field(default_factory=SceneMix)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """Work item: the pictures of one folder."""

    split: str
    seed: int
    count: int
    mix: SceneMix
    out: Path

    @property
    def folder(self) -> Path:
        """Folder of its images."""
        return self.out / "images" / self.split / str(self.seed)


def main(config: Config) -> None:
    """Make the shards that are missing, and the two files that describe them."""
    shards = [shard for shard in plan_shards(config) if not shard.folder.is_dir()]
    config.out.mkdir(parents=True, exist_ok=True)
    write_manifest(config)
    if config.jobs > 1 and len(shards) > 1:
        with get_context("spawn").Pool(config.jobs) as pool:  # forked ones would inherit OpenGL's state
            for _ in track(pool.imap_unordered(make_shard, shards), description="shards", total=len(shards)):
                pass
        return
    for shard in track(shards, description="shards"):
        make_shard(shard)


def plan_shards(config: Config) -> list[Shard]:
    """Return every shard of `config`, existing ones included."""
    shards = []
    for split, start in SPLITS.items():
        mix = replace(config.mix, **_CHANGES.get(split, {}))
        total = getattr(config, split)
        for number, first in enumerate(range(0, total, config.shard)):
            count, seed = min(config.shard, total - first), start + config.seed + number
            shards.append(Shard(split=split, seed=seed, count=count, mix=mix, out=config.out))
    return shards


def make_shard(shard: Shard) -> None:
    """Draw a shard's pictures and move them to their folder when complete."""
    from sim_twin.detection_data.scene_renderer import SceneRenderer
    from sim_twin.detection_data.scenes import draw_scene

    images = shard.out / "partial" / f"{shard.seed}.{os.getpid()}"  # two runs may make the same shard
    labels = shard.out / "labels" / shard.split / str(shard.seed)
    images.mkdir(parents=True)
    labels.mkdir(parents=True, exist_ok=True)
    renderer = SceneRenderer(shard.seed)
    for number in range(shard.count):
        # 2: the props are drawn from the stream [seed, 1].
        picture = draw_scene(renderer, np.random.default_rng([shard.seed, 2, number]), shard.mix)
        name = f"{number:04d}_{picture.appearance}"
        _write_picture(picture, images / f"{name}.jpg", labels / f"{name}.txt")
    renderer.close()
    if shard.folder.is_dir():  # another process was faster
        shutil.rmtree(images)
    else:
        shard.folder.parent.mkdir(parents=True, exist_ok=True)
        images.rename(shard.folder)  # last: a shard that exists is complete


def write_manifest(config: Config) -> None:
    """Write `data.yaml`, which ultralytics reads, and `recipe.json`."""
    names = "".join(f"  {number}: {name}\n" for number, name in enumerate(CLASSES))
    folders = "".join(f"{split}: images/{split}\n" for split in ("train", "val"))
    (config.out / "data.yaml").write_text(f"path: {config.out.resolve()}\n{folders}names:\n{names}")
    recipe = {key: value for key, value in asdict(config).items() if key not in ("out", "jobs")} | {"changes": _CHANGES}
    (config.out / "recipe.json").write_text(json.dumps(recipe, indent=1) + "\n")


def to_line(label: Label) -> str:
    """Return a label in YOLO's format: class index, then a polygon's corners as ratios of width and height.

    Corners are the middles of the outermost pixels. Parts of one object, and only they, are joined by thin bridges;
    holes are filled.
    """
    from ultralytics.data.converter import merge_multi_segment

    height, width = label.mask.shape
    outlines, _ = cv2.findContours(label.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    parts = [outline.reshape(-1, 2) for outline in outlines if len(outline) > 2]
    # The outline of one or two pixels is no polygon; repeated corners make it one.
    parts = parts or [np.repeat(outlines[0].reshape(-1, 2), 3, axis=0)[:3]]
    corners = parts[0] if len(parts) == 1 else np.concatenate(merge_multi_segment([p.ravel().tolist() for p in parts]))
    ratios = (corners + 0.5) / [width, height]
    return f"{CLASSES.index(label.name)} " + " ".join(f"{ratio:.5f}" for ratio in ratios.ravel())


def read_labels(path: Path, shape: tuple[int, int]) -> tuple[Label, ...]:
    """Return the labels of a file of `to_line` lines, for a picture of `shape` (H, W)."""
    labels = []
    for line in path.read_text().splitlines():
        number, *ratios = line.split()
        corners = np.array(ratios, dtype=float).reshape(-1, 2) * shape[::-1]
        mask = np.zeros(shape, np.uint8)
        cv2.fillPoly(mask, [corners.astype(np.int32)], 1)
        labels.append(Label(name=CLASSES[int(number)], mask=mask.astype(bool)))
    return tuple(labels)


def _write_picture(picture: LabelledImage, image: Path, labels: Path) -> None:
    quality = [cv2.IMWRITE_JPEG_QUALITY, 92]
    cv2.imwrite(str(image), cv2.cvtColor(picture.colour, cv2.COLOR_RGB2BGR), quality)
    labels.write_text("".join(to_line(label) + "\n" for label in picture.labels))


if __name__ == "__main__":
    main(tyro.cli(Config))

"""The detector's data on disk: labels round-trip through files, and an interrupted run resumes."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.base.errors import CameraError
from scripts.train.make_detection_dataset import SPLITS, Config, main, plan_shards, read_labels, to_line
from sim_twin.camera.render import open_egl
from sim_twin.detection_data.props import CLASSES
from sim_twin.detection_data.scenes import Label

SHAPE = (480, 640)


def disc(*places: tuple[int, int, int]) -> np.ndarray:
    mask = np.zeros(SHAPE, np.uint8)
    for x, y, radius in places:
        cv2.circle(mask, (x, y), radius, 1, -1)
    return mask.astype(bool)


@pytest.mark.parametrize(
    "mask", [disc((300, 200, 60)), disc((5, 470, 40)), disc((200, 200, 50), (320, 210, 40), (450, 300, 30))]
)
def test_a_mask_round_trips_through_the_file(mask: np.ndarray, tmp_path: Path) -> None:
    file = tmp_path / "labels.txt"
    file.write_text(to_line(Label(name="cylinder", mask=mask)) + "\n")
    (back,) = read_labels(file, SHAPE)
    assert back.name == "cylinder"
    assert (back.mask & mask).sum() / (back.mask | mask).sum() > 0.97
    assert np.abs(back.box() - Label(name="cylinder", mask=mask).box()).max() <= 1


def test_a_line_is_a_class_index_and_ratios_of_the_picture() -> None:
    number, *ratios = to_line(Label(name="box", mask=disc((630, 10, 30)))).split()
    assert CLASSES[int(number)] == "box"
    values = np.array(ratios, dtype=float)
    assert len(values) % 2 == 0 and values.min() >= 0.0 and values.max() <= 1.0


def test_a_mask_of_two_pixels_still_has_an_outline() -> None:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[100, 100:102] = True
    assert len(to_line(Label(name="box", mask=mask)).split()) >= 7


def test_a_picture_without_objects_has_no_labels(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").write_text("")
    assert read_labels(tmp_path / "empty.txt", SHAPE) == ()


def test_splits_share_no_seed_and_have_the_requested_sizes() -> None:
    shards = plan_shards(Config(train=250, val=30, empty=10, shard=100))
    assert len({shard.seed for shard in shards}) == len(shards)
    for split, count in (("train", 250), ("val", 30), ("empty", 10)):
        assert sum(shard.count for shard in shards if shard.split == split) == count
    assert all(shard.mix.empty == 1.0 for shard in shards if shard.split == "empty")
    assert all(b - a > 100_000 for a, b in pairwise(sorted(SPLITS.values())))


@pytest.mark.integration
def test_a_second_run_makes_only_missing_shards(tmp_path: Path) -> None:
    try:
        open_egl(16, 16).free()
    except CameraError:
        pytest.skip("no OpenGL through EGL on this machine")
    config = Config(train=4, val=2, empty=1, shard=2, out=tmp_path)
    main(replace(config, train=2))
    first = {path: path.read_bytes() for path in sorted((tmp_path / "images").rglob("*.jpg"))}
    assert len(first) == 5
    (kept,) = (tmp_path / "images/train/1000000").glob("0000_*.jpg")
    kept.write_bytes(b"not drawn again")
    main(config)
    assert kept.read_bytes() == b"not drawn again"
    images = sorted((tmp_path / "images").rglob("*.jpg"))
    assert len(images) == 7
    labels = [Path(str(path).replace("/images/", "/labels/")).with_suffix(".txt") for path in images]
    assert all(path.is_file() for path in labels)
    shutil.rmtree(tmp_path / "images/val/2000000")
    main(config)
    (again,) = (tmp_path / "images/val/2000000").glob("0000_*.jpg")
    assert again.read_bytes() == first[again]  # a shard depends on its seed alone
    assert not list((tmp_path / "partial").iterdir())

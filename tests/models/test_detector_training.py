"""How the detector learns: what cards hide, what the loss is, and that a phase goes on where it stopped."""

import random
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("ultralytics")

import torch

from models.detector_training import (
    AUGMENTATION,
    Bf16SegmentationModel,
    HideBehindCard,
    Phase,
    clip_polygon,
    read_checkpoint,
    train_phase,
)

SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])


def area(corners: np.ndarray) -> float:
    x, y = corners.T
    return 0.5 * abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1)))


def test_a_polygon_is_cut_along_the_line() -> None:
    half = clip_polygon(SQUARE, np.array([1.0, 0.0]), 4.0)
    assert area(half) == pytest.approx(40.0)
    assert half[:, 0].max() == pytest.approx(4.0)
    diagonal = np.array([1.0, 1.0]) / np.sqrt(2)
    assert area(clip_polygon(SQUARE, diagonal, 10.0 / np.sqrt(2))) == pytest.approx(50.0)
    assert clip_polygon(SQUARE, np.array([1.0, 0.0]), 99.0) == pytest.approx(SQUARE)
    assert len(clip_polygon(SQUARE, np.array([1.0, 0.0]), -1.0)) == 0


def test_a_card_hides_part_of_the_only_object_and_its_label_shrinks_as_much() -> None:
    from ultralytics.utils.instance import Instances

    outline = np.array([[100 + 60 * np.cos(a), 120 + 90 * np.sin(a)] for a in np.linspace(0, 2 * np.pi, 400)])
    random.seed(1)
    changed = 0
    for _ in range(60):
        image = np.full((240, 320, 3), 255, np.uint8)
        cv2.fillPoly(image, [outline.astype(np.int32)], (7, 7, 7))
        box = np.array([[*outline.min(axis=0), *outline.max(axis=0)]], dtype=np.float32)
        instances = Instances(box, outline[None].astype(np.float32), None, bbox_format="xyxy", normalized=False)
        labels = HideBehindCard()({"img": image.copy(), "instances": instances})
        after = labels["instances"]
        if np.array_equal(labels["img"], image):
            assert np.array_equal(after.segments[0], outline.astype(np.float32))
            continue
        changed += 1
        shows = np.zeros(image.shape[:2], np.uint8)
        cv2.fillPoly(shows, [after.segments[0].astype(np.int32)], 1)
        inside = cv2.erode(shows, np.ones((7, 7), np.uint8)).astype(bool)
        assert (labels["img"][inside] == 7).all()  # the card covers nothing of what the label keeps
        assert after.bboxes[0] == pytest.approx([*after.segments[0].min(axis=0), *after.segments[0].max(axis=0)], abs=1)
    assert 4 <= changed <= 25


def test_two_objects_are_left_alone() -> None:
    from ultralytics.utils.instance import Instances

    segments = np.stack([np.resize(SQUARE, (20, 2)), np.resize(SQUARE + 20, (20, 2))]).astype(np.float32)
    boxes = np.array([[0, 0, 10, 10], [20, 20, 30, 30]], dtype=np.float32)
    image = np.zeros((64, 64, 3), np.uint8)
    for _ in range(20):
        labels = {"img": image, "instances": Instances(boxes, segments, None, bbox_format="xyxy", normalized=False)}
        assert len(HideBehindCard()(labels)["instances"]) == 2
        assert not labels["img"].any()


def test_the_loss_in_bfloat16_is_the_loss_but_for_rounding() -> None:
    from ultralytics.cfg import get_cfg
    from ultralytics.nn.tasks import SegmentationModel

    torch.manual_seed(0)
    model = Bf16SegmentationModel("yolov8n-seg.yaml", nc=3, verbose=False)
    model.args = get_cfg(overrides=AUGMENTATION)
    masks = torch.zeros(1, 16, 16)
    masks[0, 4:12, 4:12] = 1
    batch = {"img": torch.rand(1, 3, 64, 64), "cls": torch.zeros(1, 1), "batch_idx": torch.zeros(1)}
    batch |= {"bboxes": torch.tensor([[0.5, 0.5, 0.5, 0.5]]), "masks": masks}
    model.train()
    with torch.no_grad():
        ours, parts = model.loss(batch)
        plain, _ = SegmentationModel.loss(model, batch)
    assert ours.dtype == torch.float32
    assert {"box_loss", "seg_loss", "cls_loss", "dfl_loss"} <= set(parts)
    assert ours.sum().item() == pytest.approx(plain.sum().item(), rel=0.05)


def test_a_phase_that_is_done_is_not_done_again_and_gives_finite_weights(tmp_path: Path) -> None:
    for split in ("train", "val"):
        (tmp_path / "images" / split).mkdir(parents=True)
        (tmp_path / "labels" / split).mkdir(parents=True)
        for number in range(2):
            image = np.zeros((48, 64, 3), np.uint8)
            image[12:36, 16:48] = 200
            cv2.imwrite(str(tmp_path / f"images/{split}/{number}.jpg"), image)
            (tmp_path / f"labels/{split}/{number}.txt").write_text("1 0.25 0.25 0.75 0.25 0.75 0.75 0.25 0.75\n")
    names = "names: {0: bottle, 1: box, 2: cylinder}\n"
    (tmp_path / "data.yaml").write_text(f"path: {tmp_path}\ntrain: images/train\nval: images/val\n{names}")
    phase = Phase(imgsz=64, epochs=1, lr0=1e-3, lrf=0.5, warmup_epochs=0.0, batch=2)
    threads = torch.get_num_threads()
    where = {"data": tmp_path / "data.yaml", "folder": tmp_path / "run/0", "start": None, "seed": 0}
    last = train_phase(phase, **where, threads=threads)
    written = last.stat().st_mtime_ns
    assert train_phase(phase, **where, threads=threads) == last
    assert last.stat().st_mtime_ns == written
    network = read_checkpoint(last)
    assert all(torch.isfinite(value).all() for value in network.state_dict().values())
    following = train_phase(phase, **where | {"folder": tmp_path / "run/1", "start": last}, threads=threads)
    assert following.parent.parent.name == "1" and following.is_file()

"""The scripts that draw the documentation's animated picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scripts.docs.record_demo import Config, main, write_webp
from scripts.docs.wrist_overlay import draw_caption, draw_mask

GREY = np.full((60, 80, 3), 100, np.uint8)


def test_mask_is_tinted_and_nothing_else_but_its_box() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:50] = True
    picture = draw_mask(GREY, mask, (25, 15, 55, 45))
    assert (picture[30, 40] != GREY[30, 40]).any()
    assert (picture[55, 5] == GREY[55, 5]).all()
    assert (picture[15, 40] != GREY[15, 40]).any()  # the box's upper edge
    assert (GREY == 100).all()


def test_caption_covers_the_upper_edge_alone() -> None:
    picture = draw_caption(GREY, "twin")
    assert (picture[:28] != GREY[:28]).any()
    assert (picture[28:] == GREY[28:]).all()


def test_animation_holds_all_frames_and_stays_at_the_last(tmp_path: Path) -> None:
    frames = [Image.fromarray(np.full((36, 96, 3), level, np.uint8)) for level in (0, 120, 250)]
    write_webp(frames, Config(out=tmp_path / "demo.webp"))
    with Image.open(tmp_path / "demo.webp") as animation:
        assert (animation.n_frames, animation.size) == (3, (96, 36))
        durations = []
        for number in range(3):
            animation.seek(number)
            animation.load()
            durations.append(animation.info["duration"])
    assert durations == [80, 80, 1500]


@pytest.mark.slow
def test_recorded_pick_holds_its_object_and_its_picture_is_small(tmp_path: Path) -> None:
    assert main(Config(rate_hz=2.0, out=tmp_path / "demo.webp")) == 0
    with Image.open(tmp_path / "demo.webp") as animation:
        assert animation.size == (960, 360)

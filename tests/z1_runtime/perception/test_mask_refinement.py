"""What the depth says of what was seen in the colours: patterns are flat, things are not."""

import numpy as np
import pytest

from models.types import Detection
from tests.support.tabletop_scene import Box, Cylinder, noisy_frame, truth
from z1_runtime.perception.detector import mask_box
from z1_runtime.perception.detectors.yolo import is_flat

BOTTLE = Cylinder(0.5, 0.0, 0.0325, 0.2)
THINGS = [
    BOTTLE,
    Cylinder(0.4, 0.1, 0.03, 0.15),
    Box(0.5, 0.05, (0.2, 0.06, 0.06), 0.8),
    Box(0.45, 0.0, (0.06, 0.1, 0.03), 1.2),  # the flattest that is a box
    Box(0.42, 0.0, (0.15, 0.15, 0.15), 0.0),
]


def seen(mask: np.ndarray, with_mask: bool = True) -> Detection:
    return Detection(label="box", confidence=0.9, box_px=mask_box(mask), mask=mask if with_mask else None)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("thing", THINGS)
def test_a_thing_does_not_lie_flat(thing: Box | Cylinder, seed: int) -> None:
    frame = noisy_frame([thing], seed=seed)
    assert not is_flat(seen(truth(frame)), frame.depth_m)
    assert not is_flat(seen(truth(frame), with_mask=False), frame.depth_m)


@pytest.mark.parametrize("thing", THINGS)
def test_a_mask_that_misses_a_thing_s_border_does_not_make_it_flat(thing: Box | Cylinder) -> None:
    frame = noisy_frame([thing])
    mask = truth(frame)
    u_min, v_min, u_max, v_max = mask_box(mask)
    du, dv = (u_max - u_min) // 12, (v_max - v_min) // 12
    inner = np.zeros_like(mask)
    inner[v_min + dv : v_max - dv, u_min + du : u_max - du] = True
    assert not is_flat(seen(mask & inner), frame.depth_m)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("where", [(300, 240, 60, 100), (420, 330, 120, 80), (100, 380, 40, 60)])
def test_a_pattern_on_the_table_is_flat(where: tuple[int, int, int, int], seed: int) -> None:
    frame = noisy_frame([], seed=seed)
    left, top, width, height = where
    mask = np.zeros(frame.depth_m.shape, dtype=bool)
    mask[top : top + height, left : left + width] = True
    assert is_flat(seen(mask), frame.depth_m)
    assert is_flat(seen(mask, with_mask=False), frame.depth_m)


def test_without_depth_nothing_is_called_flat() -> None:
    frame = noisy_frame([])
    mask = np.zeros(frame.depth_m.shape, dtype=bool)
    mask[300:380, 420:520] = True
    assert not is_flat(seen(mask), np.where(mask, 0.0, frame.depth_m))
    assert not is_flat(seen(mask), np.where(mask, frame.depth_m, 0.0))

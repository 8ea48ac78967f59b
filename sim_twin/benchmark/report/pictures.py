"""Pictures of the final states of episodes, rendered from their rows."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from sim_twin.benchmark.episodes.methods import file_name
from sim_twin.benchmark.episodes.rows import Row
from sim_twin.benchmark.episodes.scenarios import Scenario
from sim_twin.camera.external_view import draw_picture
from sim_twin.model.objects import OBJECTS
from sim_twin.model.parts import GraspObject

Choice = Literal["failures", "all", "none"]
SHOWN = 12
"""Failures that the report shows."""
_SIZE, _SMALL = (960, 540), (480, 270)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodePicture:
    """One episode's picture in the report."""

    caption: str
    jpeg: bytes
    """Small JPEG file."""
    recording: str = ""
    """Its .rrd file, relative to the report's folder; empty where there is none."""


def draw_pictures(
    rows: Sequence[Row], choice: Choice, folder: Path, shapes: Mapping[str, GraspObject] | None = None
) -> list[tuple[Row, EpisodePicture]]:
    """Render the final state of episodes as <scenario>-<method>.png in `folder`.

    Args:
        rows: of any methods; an episode in which the arm never moved has no final state and no picture.
        choice: `failures` draws those that the report shows, `all` every episode.
        folder: is created.
        shapes: the objects that are none of the named ones, by name; no others can be drawn.

    Returns:
        The rows that the report shows, with their pictures.
    """
    if choice == "none":
        return []
    shapes = shapes or {}
    rows = [row for row in rows if _can_be_drawn(row, shapes)]
    shown = choose_failures(rows)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    for row in rows if choice == "all" else shown:
        png = draw_picture(Scenario.from_row(row, shapes).scene(), np.array(row["final_qpos"]), *_SIZE)
        (folder / f"{row['scenario']}-{file_name(row['method'])}.png").write_bytes(png)
        if row in shown:
            caption = f"{row['scenario']}, {row['method']}: {row['mode']}"
            pictures.append((row, EpisodePicture(caption=caption, jpeg=_encode_thumbnail(png))))
    return pictures


def choose_failures(rows: Sequence[Row], maximum: int = SHOWN) -> list[Row]:
    """Return failures in which the arm moved, of as many kinds as possible: each method's failure modes in turn."""
    kinds: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if not row["success"] and row.get("final_qpos") is not None:
            kinds.setdefault((row["method"], row["mode"]), []).append(row)
    turns = chain.from_iterable(zip_longest(*kinds.values()))
    return [row for row in turns if row is not None][:maximum]


def _can_be_drawn(row: Row, shapes: Mapping[str, GraspObject]) -> bool:
    return row.get("final_qpos") is not None and (row["object"] in OBJECTS or row["object"] in shapes)


def _encode_thumbnail(png: bytes) -> bytes:
    file = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").resize(_SMALL, Image.Resampling.LANCZOS).save(file, "JPEG", quality=80)
    return file.getvalue()

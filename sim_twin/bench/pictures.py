"""Pictures of how episodes ended, drawn afterwards from what their rows hold."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from sim_twin.bench.methods import file_name
from sim_twin.bench.rows import Row
from sim_twin.bench.scenarios import Scenario
from sim_twin.view import draw_picture

Choice = Literal["failures", "all", "none"]
SHOWN = 12
"""How many failures the report shows."""
_SIZE, _SMALL = (960, 540), (480, 270)


def draw_pictures(rows: Sequence[Row], choice: Choice, folder: Path) -> dict[str, bytes]:
    """Draw the final state of episodes as <scenario>-<method>.png in `folder`.

    Args:
        rows: of any methods; an episode in which the arm never moved has no final state and no picture.
        choice: `failures` draws those that the report shows, `all` every episode.
        folder: is made.

    Returns:
        Small JPEG files of the chosen failures by what is to be said of each.
    """
    if choice == "none":
        return {}
    shown = choose_failures(rows)
    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, bytes] = {}
    for row in rows if choice == "all" else shown:
        if row.get("final_qpos") is None:
            continue
        png = draw_picture(Scenario.of(row).scene(), np.array(row["final_qpos"]), *_SIZE)
        (folder / f"{row['scenario']}-{file_name(row['method'])}.png").write_bytes(png)
        if row in shown:
            pictures[f"{row['scenario']}, {row['method']}: {row['mode']}"] = _small_jpeg(png)
    return pictures


def choose_failures(rows: Sequence[Row], most: int = SHOWN) -> list[Row]:
    """Return failures in which the arm moved, as different as can be: each method's failure modes take turns."""
    kinds: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if not row["success"] and row.get("final_qpos") is not None:
            kinds.setdefault((row["method"], row["mode"]), []).append(row)
    turns = chain.from_iterable(zip_longest(*kinds.values()))
    return [row for row in turns if row is not None][:most]


def _small_jpeg(png: bytes) -> bytes:
    file = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").resize(_SMALL, Image.Resampling.LANCZOS).save(file, "JPEG", quality=80)
    return file.getvalue()

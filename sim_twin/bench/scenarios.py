"""What stands where in each episode: the paper's 81 poses, and whatever a user adds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from typing import Any

from sim_twin.objects import EXTENDED_OBJECTS, OBJECT_NAMES, PAPER_OBJECTS
from sim_twin.scene import SceneConfig

OBJECT_SETS = {"paper": PAPER_OBJECTS, "extended": EXTENDED_OBJECTS}
"""Objects by the name of their set."""
DISTANCES_M = {"near": 0.40, "mid": 0.48, "far": 0.56}
"""The object's centre from the base along x [m]."""
LATERALS_M = {"left": 0.15, "centre": 0.0, "right": -0.15}
"""The object's centre along y [m]."""
PITCHES_DEG = (-45.0, 0.0, 45.0)
"""Lean about the base's y axis [°]; negative leans towards the robot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One episode's circumstances; with the code's version they determine it wholly."""

    object: str
    """One of `sim_twin.objects.OBJECT_NAMES`."""
    distance: str
    """A key of `DISTANCES_M`."""
    lateral: str
    """A key of `LATERALS_M`."""
    pitch_deg: float
    """Lean of the object [°]."""
    seed: int = 0
    """Of the camera's noise, of the generator and of everything drawn below."""
    occlusion: float = 0.0
    """Share of the object's pixels hidden from the camera."""

    def __post_init__(self) -> None:
        _one_of("object", self.object, OBJECT_NAMES)
        _one_of("distance", self.distance, tuple(DISTANCES_M))
        _one_of("lateral", self.lateral, tuple(LATERALS_M))
        if not 0.0 <= self.occlusion < 1.0:
            raise ValueError(f"occlusion is {self.occlusion!r}; allowed is 0 up to, not including, 1.")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; allowed is 0 or more.")

    @property
    def key(self) -> str:
        """A name for it that is unique and the same in every run."""
        occluded = f"-occluded{self.occlusion:g}" if self.occlusion else ""
        return f"{self.object}-{self.distance}-{self.lateral}-{self.pitch_deg:+g}{occluded}-s{self.seed}"

    @property
    def draw_seed(self) -> int:
        """A seed of this scenario's own, so that no two share their noise."""
        return int.from_bytes(hashlib.sha256(self.key.encode()).digest()[:4], "big")

    def scene(self) -> SceneConfig:
        """Return the twin's scene."""
        return SceneConfig(
            object=self.object,
            distance_m=DISTANCES_M[self.distance],
            lateral_m=LATERALS_M[self.lateral],
            pitch_deg=self.pitch_deg,
            seed=self.draw_seed,
        )

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Scenario:
        """Return the scenario of a table's row: what `features` gave, maybe among other columns."""
        return cls(**{field.name: row[field.name] for field in fields(cls)})

    def features(self) -> dict[str, object]:
        """Return what identifies it, as columns of a table."""
        return {"scenario": self.key, **asdict(self)}


def grid(
    objects: Sequence[str] = PAPER_OBJECTS, seeds: Sequence[int] = (0,), occlusions: Sequence[float] = (0.0,)
) -> list[Scenario]:
    """Return the poses of each object for each seed and occlusion.

    The paper's objects have 27 poses each, 81 together; the others stand upright only, in 9.
    """
    return [
        Scenario(object=name, distance=distance, lateral=lateral, pitch_deg=pitch, seed=seed, occlusion=occlusion)
        for seed, occlusion, name in product(seeds, occlusions, objects)
        for pitch, distance, lateral in product(
            PITCHES_DEG if name in PAPER_OBJECTS else (0.0,), DISTANCES_M, LATERALS_M
        )
    ]


def _one_of(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ValueError(f"there is no {name} {value!r}; choose one of: {', '.join(allowed)}.")

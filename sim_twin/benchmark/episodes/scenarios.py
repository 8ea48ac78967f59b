"""Scenarios of the episodes: the paper's 81 poses, and further objects and conditions."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from typing import Any

from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.clutter import MAX_NEIGHBOURS, draw_neighbours
from sim_twin.benchmark.episodes.physics import Physics
from sim_twin.model.objects import EXTENDED_OBJECTS, OBJECT_NAMES, PAPER_OBJECTS
from sim_twin.model.parts import GraspObject
from sim_twin.model.scene import SceneConfig

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
    """Conditions of one episode; with the code's version they determine it fully."""

    object: str
    """One of `sim_twin.model.objects.OBJECT_NAMES`, or the name of `shape`."""
    distance: str
    """A key of `DISTANCES_M`."""
    lateral: str
    """A key of `LATERALS_M`."""
    pitch_deg: float
    """Lean of the object [°]."""
    seed: int = 0
    """Seed of the camera's noise, of the generator and of everything sampled below."""
    occlusion: float = 0.0
    """Ratio of the object's pixels that are occluded."""
    clutter: int = 0
    """Number of neighbours around the object."""
    physics_noise: bool = False
    """Whether friction, mass, extrinsics and actuation latency differ from the runtime's model."""
    shape: GraspObject | None = field(default=None, repr=False)
    """Shape of an object that is none of the named ones; its name must identify it (see `columns`)."""

    def __post_init__(self) -> None:
        if self.shape is None:
            _check_choice("object", self.object, OBJECT_NAMES)
        _check_choice("distance", self.distance, tuple(DISTANCES_M))
        _check_choice("lateral", self.lateral, tuple(LATERALS_M))
        if not 0.0 <= self.occlusion < 1.0:
            raise InvalidValueError(
                f"scenario: occlusion is out of range ({self.occlusion!r}, allowed 0 up to, not including, 1). "
                "Lower it.",
                code="scenario_occlusion",
            )
        if self.seed < 0:
            raise InvalidValueError(
                f"scenario: seed is negative ({self.seed}, allowed 0 or more). Give 0 or more.", code="scenario_seed"
            )
        if not 0 <= self.clutter <= MAX_NEIGHBOURS:
            raise InvalidValueError(
                f"scenario: clutter is out of range ({self.clutter}, allowed 0 to {MAX_NEIGHBOURS} neighbours). "
                "Give fewer.",
                code="scenario_clutter",
            )

    @property
    def key(self) -> str:
        """Unique name, the same in every run."""
        more = f"-occluded{self.occlusion:g}" if self.occlusion else ""
        more += f"-clutter{self.clutter}" if self.clutter else ""
        more += "-noisy" if self.physics_noise else ""
        return f"{self.object}-{self.distance}-{self.lateral}-{self.pitch_deg:+g}{more}-s{self.seed}"

    @property
    def draw_seed(self) -> int:
        """Seed of this scenario alone, so that no two have the same noise."""
        # Not `hash()`, which differs between processes
        return int.from_bytes(hashlib.sha256(self.key.encode()).digest()[:4], "big")

    @property
    def physics(self) -> Physics:
        """Deviations of the world from the runtime's model."""
        return Physics.sample(self.draw_seed) if self.physics_noise else Physics()

    def scene(self) -> SceneConfig:
        """Return the twin's scene."""
        alone = SceneConfig(
            object=self.object,
            shape=self.shape,
            distance_m=DISTANCES_M[self.distance],
            lateral_m=LATERALS_M[self.lateral],
            pitch_deg=self.pitch_deg,
            seed=self.draw_seed,
            **asdict(self.physics),
        )
        return replace(alone, neighbours=draw_neighbours(alone, self.clutter, self._others(), self.draw_seed))

    def _others(self) -> list[str]:
        """Return possible neighbours: other objects of its set, so that its class identifies it."""
        own_set = EXTENDED_OBJECTS if self.object in EXTENDED_OBJECTS else PAPER_OBJECTS
        return [name for name in own_set if name != self.object]

    @classmethod
    def from_row(cls, row: Mapping[str, Any], shapes: Mapping[str, GraspObject] | None = None) -> Scenario:
        """Return the scenario of a table's row: what `columns` gave, maybe among other columns.

        Args:
            row: column to value; one of an earlier version may lack what has a default.
            shapes: the objects that are none of the named ones, by name.
        """
        columns = (field.name for field in fields(cls) if field.name != "shape")
        known = {name: row[name] for name in columns if row.get(name) is not None}
        return cls(**known, shape=(shapes or {}).get(row["object"]))

    def identity(self) -> dict[str, object]:
        """Return the key, the fields and the sampled physics as columns of a table; `scene()` is not needed for it."""
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "shape"}
        return {"scenario": self.key, **own, **asdict(self.physics)}

    def columns(self) -> dict[str, object]:
        """Return the identity and the sampled neighbours as columns of a table."""
        neighbours = [neighbour.object for neighbour in self.scene().neighbours] if self.clutter else []
        return {**self.identity(), "neighbours": neighbours}


def grid(
    objects: Sequence[str] = PAPER_OBJECTS,
    seeds: Sequence[int] = (0,),
    occlusions: Sequence[float] = (0.0,),
    clutters: Sequence[int] = (0,),
    *,
    physics_noise: bool = False,
    shapes: Mapping[str, GraspObject] | None = None,
) -> list[Scenario]:
    """Return the poses of each object for each seed, occlusion and number of neighbours.

    The paper's objects and those of `shapes` have 27 poses each; the others stand upright only, in 9.
    """
    shapes = shapes or {}
    return [
        Scenario(
            object=name,
            shape=shapes.get(name),
            distance=distance,
            lateral=lateral,
            pitch_deg=pitch,
            seed=seed,
            occlusion=occlusion,
            clutter=clutter,
            physics_noise=physics_noise,
        )
        for seed, occlusion, clutter, name in product(seeds, occlusions, clutters, objects)
        for pitch, distance, lateral in product(
            (0.0,) if name in EXTENDED_OBJECTS else PITCHES_DEG, DISTANCES_M, LATERALS_M
        )
    ]


def _check_choice(name: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise InvalidValueError(
            f"scenario: {name} is unknown ({value!r}, allowed {', '.join(allowed)}). Choose one of these.",
            code=f"scenario_{name}",
        )

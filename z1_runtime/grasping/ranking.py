"""Ranking of grasps: the features of each, and the numbers that weigh them, configured or fitted by `./z1 tune`.

The file of `./z1 tune` is YAML of plain numbers; nothing in it is executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hal.base.errors import ConfigError, InvalidValueError, UsageError
from hal.base.files import atomic_write, plain, read_yaml, structure
from hal.base.transforms import transform_points
from models.obb.mvbb import FitMethod, fit_obb, nearest_faces
from models.obb.obb import OrientedBox
from models.types import GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.types import Observation

FEATURES = {
    "generator": "the generator's score, in [0, 1]",
    "alignment": "with one of the two faces of the upright box that are nearest to the camera, in [-1, 1]",
    "distance_to_centre_m": "from the contacts' midpoint to the object's centre [m]",
    "above_m": "height of the contacts' midpoint over the object's centre [m]",
    "support": "ratio of the pads that the object fills, in [0, 1]",
    "level": "1 where the jaws' push is level, 0 where friction just holds",
    "width_m": "of the object between the jaws [m]",
    "down": "downward part of the approach, sine of its angle, in [-1, 1]",
    "outward": "part of the approach that points out from the arm's base, cosine of the angle, in [-1, 1]",
    "reach_m": "of the contacts' midpoint from the base's axis [m]",
    "height_m": "of the contacts' midpoint over the table [m]",
}
"""Name to meaning, in the order of the columns that `measure_features` returns."""

FORMER_NAMES = {"away_m": "distance_to_centre_m"}
"""Names of features in scoring files and episode tables of version 0.1, and their names here."""

_N_FACES = 2  # whatever a ranking's own k, so that a head means the same under each
_TOP_PERCENTILE = 99.0  # of the heights: single points above the object do not count


def fit_upright_box(observation: Observation) -> OrientedBox:
    """Return the object's upright box in the camera frame.

    Raises:
        DegenerateCloudError: the object's cloud spans no box.
    """
    return fit_obb(observation.object_points, "upright", up=observation.T_base_camera[2, :3])


def box_alignment(grasps: GraspSet, box: OrientedBox) -> np.ndarray:
    """Return the alignment (N,) of each of `grasps` with a near face of `box`, in [-1, 1]; both in the camera frame."""
    normals = box.face_normals[nearest_faces(box, _N_FACES)]
    return np.max(-grasps.T_camera_grasps[:, :3, 2] @ normals.T, axis=1)


def object_centre_from_table(box: OrientedBox, scene: PlanningScene) -> np.ndarray:
    """Return the object's centre (3,) in the base frame: that of `box`, at half the object's height over the table.

    Of an object that leans towards the camera only the top is observed, which puts the box's own centre too high.
    """
    centre = transform_points(scene.T_base_camera, box.T_camera_box[:3, 3])
    top_m = float(np.percentile(scene.table.height_m(scene.object_points), _TOP_PERCENTILE))
    return centre + (0.5 * top_m - scene.table.height_m(centre)) * scene.table.normal


def measure_features(candidates: GraspCandidates) -> np.ndarray:
    """Return the columns `FEATURES`, (M, 11), of M candidates; one without a point between its pads has no support.

    Raises:
        DegenerateCloudError: the object's cloud spans no box.
    """
    scene, table = candidates.scene, candidates.scene.table
    box = candidates.upright_box or fit_upright_box(scene.observation)
    centre = object_centre_from_table(box, scene)
    support, level = candidates.support, candidates.level  # fit the candidates, which measures their widths
    contacts, approaches = candidates.contacts, candidates.approaches
    reach_m = np.linalg.norm(contacts[:, :2], axis=1)
    outward = np.sum(approaches[:, :2] * contacts[:, :2], axis=1) / np.maximum(reach_m, 1e-6)
    columns = {
        "generator": candidates.grasps.scores,
        "alignment": box_alignment(candidates.grasps, box),
        "distance_to_centre_m": np.linalg.norm(contacts - centre, axis=1),
        "above_m": (contacts - centre) @ table.normal,
        "support": np.nan_to_num(support),
        "level": np.nan_to_num(level),
        "width_m": candidates.widths_m,
        "down": -approaches @ table.normal,
        "outward": outward,
        "reach_m": reach_m,
        "height_m": table.height_m(contacts),
    }
    return np.column_stack([columns[name] for name in FEATURES])


FORMAT, VERSION = "z1-scoring", 1
"""First two lines of each file. The version counts changes that an older reader would misunderstand."""
NO_MIN_ALIGNMENT = -1.0
"""Alignment that every grasp reaches."""

_HINT = "Make one with `./z1 tune`."
_REMAKE = "Make it again with `./z1 tune`."
_MAX_LOGIT = 30.0  # keeps the exponential finite and a probability off 0 and 1


class ScoringError(UsageError):
    """A scoring file that cannot be used; the message names it and what to do."""

    default_code = "invalid_scoring"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoringHead:
    """Success probability of a grasp: logistic regression on standardised features."""

    features: tuple[str, ...]
    """F keys of `FEATURES`; a key of `FORMER_NAMES` becomes the present one."""
    mean: tuple[float, ...]
    """(F,) of the grasps it was fitted to."""
    scale: tuple[float, ...]
    """(F,) their standard deviations."""
    coefficients: tuple[float, ...]
    """(F,) of the standardised features."""
    intercept: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "features", tuple(FORMER_NAMES.get(name, name) for name in self.features))
        if not self.features or set(self.features) - set(FEATURES):
            raise InvalidValueError(f"features is {list(self.features)}; known: {', '.join(FEATURES)}.")
        rows = {"mean": self.mean, "scale": self.scale, "coefficients": self.coefficients}
        for name, values in rows.items():
            if len(values) != len(self.features) or not np.isfinite(values).all():
                raise InvalidValueError(f"{name} is {values}; it must hold {len(self.features)} finite numbers.")
        if min(self.scale) <= 0.0:
            raise InvalidValueError(f"scale is {self.scale}; allowed is above 0.")
        if not np.isfinite(self.intercept):
            raise InvalidValueError(f"intercept is {self.intercept}; it must be finite.")

    def probability(self, measured: np.ndarray) -> np.ndarray:
        """Return the success probability (N,) of each grasp, in (0, 1).

        Args:
            measured: (N, 11) as `z1_runtime.grasping.ranking.measure_features` returns it.
        """
        names = list(FEATURES)
        own = measured[:, [names.index(feature) for feature in self.features]]
        z = (own - self.mean) / np.array(self.scale) @ np.array(self.coefficients) + self.intercept
        return 1.0 / (1.0 + np.exp(-np.clip(z, -_MAX_LOGIT, _MAX_LOGIT)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranking:
    """Numbers by which candidates are filtered and ranked."""

    k_faces: int = 2
    """Faces nearest to the camera that may be approached."""
    alpha: float = 0.85
    """Weight of the alignment against the generator's score."""
    box_method: FitMethod = "pca"
    """Method that fits the box."""
    hard_filter: bool = True
    """Drop grasps that approach none of these faces."""
    min_alignment: float = NO_MIN_ALIGNMENT
    """Grasps less aligned come after all others."""
    min_score: float = 0.0
    """Grasps that the generator scores lower do too."""
    head: ScoringHead | None = None
    """Orders the grasps instead of α, or in the runtime instead of the weights of `planner.reachability`."""

    def __post_init__(self) -> None:
        if not 1 <= self.k_faces <= 6:
            raise InvalidValueError(f"k_faces is {self.k_faces}; allowed is 1 to 6.")
        if not 0.0 <= self.alpha <= 1.0:
            raise InvalidValueError(f"alpha is {self.alpha}; allowed is 0 to 1.")
        if self.box_method not in ("pca", "min_volume", "upright"):
            raise InvalidValueError(f"box_method is {self.box_method!r}; allowed: pca, min_volume, upright.")
        if not -1.0 <= self.min_alignment <= 1.0:
            raise InvalidValueError(f"min_alignment is {self.min_alignment}; allowed is -1 to 1.")
        if not 0.0 <= self.min_score <= 1.0:
            raise InvalidValueError(f"min_score is {self.min_score}; allowed is 0 to 1.")

    def passes_thresholds(self, alignments: np.ndarray, scores: np.ndarray) -> np.ndarray:
        """Return (N,) whether grasps with `alignments` (N,), NaN without a box, and `scores` (N,) pass both."""
        return (np.nan_to_num(alignments, nan=1.0) >= self.min_alignment) & (scores >= self.min_score)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scoring:
    """Content of a scoring file."""

    mvb: Ranking
    """The paper's ranking, in the benchmark."""
    full: Ranking
    """The runtime's."""
    tuned: tuple[str, ...] = ()
    """Those of the two that hold fitted values; the others hold the configured ones."""
    evidence: Mapping[str, Any] = field(default_factory=dict)
    """Source and evaluation of the values, for the reader."""

    def __post_init__(self) -> None:
        if set(self.tuned) - {"mvb", "full"}:
            raise InvalidValueError(f"tuned is {list(self.tuned)}; allowed: mvb, full.")


def save_scoring(scoring: Scoring, path: Path) -> None:
    """Write `scoring` to `path`, for `load_scoring`; an interrupted write leaves no file there."""
    content = {"format": FORMAT, "version": VERSION, **plain(asdict(scoring))}
    atomic_write(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120))


def load_scoring(path: Path) -> Scoring:
    """Return the scoring in the file at `path`.

    Raises:
        ScoringError: the file is missing, of another format or version, or has an unknown key or a wrong value.
    """
    try:
        content = read_yaml(path, "the scoring")
    except ConfigError as error:
        raise ScoringError(f"{error} {_HINT}", code="scoring_unreadable") from error
    if not isinstance(content, Mapping) or content.get("format") != FORMAT:
        message = f"{path} is no scoring file: its first line is not `format: {FORMAT}`. {_HINT}"
        raise ScoringError(message, code="scoring_format")
    if content.get("version") != VERSION:
        raise ScoringError(
            f"the scoring {path} is of version {content.get('version')!r}; this program reads {VERSION}. {_REMAKE}",
            code="scoring_version",
        )
    values = {key: value for key, value in content.items() if key not in ("format", "version")}
    try:
        return structure(Scoring, values, f"the scoring {path}")
    except ConfigError as error:
        code = "scoring_incomplete" if error.code == "missing_key" else "scoring_value"
        raise ScoringError(f"{error} {_REMAKE}", code=code) from error

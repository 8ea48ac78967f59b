"""A ranking's numbers: set by hand in the configuration, or fitted by `./z1 tune` and read from its file.

The file is YAML of plain numbers; reading it needs nothing but this module, and nothing in it is executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hal.base.errors import InvalidValueError, UsageError
from models.obb.mvbb import FitMethod
from z1_runtime.grasping.features import FEATURES

FORMAT, VERSION = "z1-scoring", 1
"""The first two lines of each file. The version counts changes that an older reader would misunderstand."""
NO_MIN_ALIGNMENT = -1.0
"""An alignment that every grasp reaches."""

_HINT = "Make one with `./z1 tune`."
_REMAKE = "Make it anew with `./z1 tune`."


class ScoringError(UsageError):
    """A scoring file that cannot be used; the message names it and what to do."""

    default_code = "invalid_scoring"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoringHead:
    """Logistic regression on standardised features: how likely a grasp works out."""

    features: tuple[str, ...]
    """F keys of `FEATURES`."""
    mean: tuple[float, ...]
    """(F,) of the grasps it was fitted to."""
    scale: tuple[float, ...]
    """(F,) their standard deviations."""
    coefficients: tuple[float, ...]
    """(F,) of the standardised features."""
    intercept: float

    def __post_init__(self) -> None:
        if not self.features or set(self.features) - set(FEATURES):
            raise InvalidValueError(
                f"the head goes by {', '.join(self.features) or 'no feature'}; known: {', '.join(FEATURES)}. {_REMAKE}"
            )
        rows = {"mean": self.mean, "scale": self.scale, "coefficients": self.coefficients}
        for name, values in rows.items():
            if len(values) != len(self.features) or not np.isfinite(values).all():
                raise InvalidValueError(
                    f"{name} of the head is {values}; it must hold {len(self.features)} finite numbers."
                )
        if min(self.scale) <= 0.0 or not np.isfinite(self.intercept):
            raise InvalidValueError(
                f"the head wants scale > 0 and a finite intercept; got {self.scale}, {self.intercept}."
            )

    def probability(self, measured: np.ndarray) -> np.ndarray:
        """Return the probability (N,), in (0, 1), that each grasp works out.

        Args:
            measured: (N, 11) as `z1_runtime.grasping.features.measure` returns it.
        """
        names = list(FEATURES)
        own = measured[:, [names.index(feature) for feature in self.features]]
        z = (own - self.mean) / np.array(self.scale) @ np.array(self.coefficients) + self.intercept
        return 1.0 / (1.0 + np.exp(-np.clip(z, -30.0, 30.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranking:
    """By what numbers candidates are chosen and ranked."""

    k_faces: int = 2
    """Faces nearest to the camera that may be approached."""
    alpha: float = 0.85
    """Weight of the alignment against the generator's score."""
    box_method: FitMethod = "pca"
    """How the box is fitted."""
    hard_filter: bool = True
    """Whether grasps that come at none of these faces are dropped."""
    min_alignment: float = NO_MIN_ALIGNMENT
    """Grasps less aligned come after all others."""
    min_score: float = 0.0
    """So do those to which the generator gave less."""
    head: ScoringHead | None = None
    """What orders the grasps instead of α, or in the runtime instead of the weights of `planner.ability`."""

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

    def wanted(self, alignments: np.ndarray, scores: np.ndarray) -> np.ndarray:
        """Return (N,) whether grasps with these `alignments` (N,) and generator `scores` (N,) reach both thresholds."""
        return (np.nan_to_num(alignments, nan=1.0) >= self.min_alignment) & (scores >= self.min_score)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scoring:
    """What a scoring file holds."""

    mvb: Ranking
    """Of the paper's ranking, in the benchmark."""
    full: Ranking
    """Of the runtime."""
    tuned: tuple[str, ...] = ()
    """Which of the two hold fitted values; the others hold those set by hand."""
    evidence: Mapping[str, Any] = field(default_factory=dict)
    """Where it is from and what it was judged by; for people."""

    def __post_init__(self) -> None:
        if set(self.tuned) - {"mvb", "full"}:
            raise InvalidValueError(f"tuned is {list(self.tuned)}; allowed: mvb, full.")


def save_scoring(scoring: Scoring, path: Path) -> None:
    """Write `scoring` so that `load_scoring` reads it back; the file is there only when it is whole."""
    content = {"format": FORMAT, "version": VERSION, **_plain(asdict(scoring))}
    partial = path.with_suffix(".partial")
    partial.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120), encoding="utf-8")
    partial.replace(path)


def load_scoring(path: Path) -> Scoring:
    """Return what the file at `path` holds.

    Raises:
        ScoringError: it is missing, of another format or version, or has a key or value that does not belong there.
    """
    content = _content(path)
    try:
        return Scoring(
            mvb=_ranking(content["mvb"]),
            full=_ranking(content["full"]),
            tuned=tuple(content.get("tuned", ())),
            evidence=content.get("evidence") or {},
        )
    except KeyError as error:
        raise ScoringError(f"the scoring {path} lacks {error}. {_REMAKE}") from error
    except (TypeError, ValueError) as error:
        raise ScoringError(f"the scoring {path} cannot be used: {error}") from error


def _content(path: Path) -> Mapping[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise ScoringError(f"the scoring {path} cannot be read: {why}. {_HINT}") from error
    except yaml.YAMLError as error:
        raise ScoringError(f"the scoring {path} is not YAML: {error}") from error
    if not isinstance(content, Mapping) or content.get("format") != FORMAT:
        raise ScoringError(f"{path} is no scoring file: its first line is not `format: {FORMAT}`. {_HINT}")
    if content.get("version") != VERSION:
        raise ScoringError(
            f"the scoring {path} is of version {content.get('version')!r}; this program reads {VERSION}. {_REMAKE}"
        )
    return content


def _ranking(data: Any) -> Ranking:
    values = _known(data, Ranking)
    for key, value in values.items():
        allowed = _TYPES.get(key, (int, float))
        if key != "head" and (not isinstance(value, allowed) or isinstance(value, bool) != (bool in allowed)):
            raise InvalidValueError(f"{key} is {value!r}; it must be of type {allowed[-1].__name__}.")
    if values.get("head") is not None:
        values["head"] = _head(_known(values["head"], ScoringHead))
    return Ranking(**values)


_TYPES = {"k_faces": (int,), "hard_filter": (bool,), "box_method": (str,)}


def _head(values: Mapping[str, Any]) -> ScoringHead:
    columns = {key: tuple(float(value) for value in values[key]) for key in ("mean", "scale", "coefficients")}
    features = tuple(str(name) for name in values["features"])
    return ScoringHead(features=features, intercept=float(values["intercept"]), **columns)


def _known(data: Any, kind: type) -> dict[str, Any]:
    """Return `data` as the fields of the dataclass `kind`."""
    names = [each.name for each in fields(kind)]
    if not isinstance(data, Mapping):
        raise InvalidValueError(f"it holds {data!r} where {', '.join(names)} should stand.")
    if unknown := [key for key in data if key not in names]:
        raise InvalidValueError(f"it has an unknown key {unknown[0]!r}; known: {', '.join(names)}.")
    return dict(data)


def _plain(value: Any) -> Any:
    """Return `value` as YAML's own types."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value

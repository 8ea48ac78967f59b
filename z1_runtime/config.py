"""Everything a user may tune, in one tree: defaults here, then a YAML file, then the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from hal.base.errors import InvalidValueError
from models.detector.detector import YoloConfig
from models.factory import GeneratorOptions, generator_for, split_generator_name
from z1_runtime.grasping.ranking import Ranking, load_scoring
from z1_runtime.motion.executor import ExecutorConfig
from z1_runtime.perception.detector import DETECTORS
from z1_runtime.perception.segmentation import PerceptionConfig
from z1_runtime.planning.config import PlannerConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class RuntimeConfig:
    """Settings of a pick."""

    detector: str = "yolo"
    """Detector: `yolo` (the learned one that ships: bottles, boxes and cylinders), `tabletop` (whatever rises
    above the table, no learning), or `ground_truth` (the twin's mask, for evaluation)."""
    yolo: YoloConfig = field(default_factory=YoloConfig)
    """Weights, inference runtime and thresholds of `yolo`."""
    object_class: str | None = None
    """Class to pick, for a detector with classes; None = the most confident detection."""
    generator: str = "diffusion"
    """Grasp generator: `diffusion` (learned, for any parallel jaw) and `diffusion_z1` (for the Z1's gripper) ship;
    `antipodal`, `obb_sweep` (no learning), `graspgen`, `graspgenx` (NVIDIA's; weights are yours to bring), or
    `union:a+b` of any of them."""
    generator_options: GeneratorOptions = field(default_factory=GeneratorOptions)
    """Weights of the generator, and the process of NVIDIA's."""
    n_candidates: int = 800
    """Grasps the generator proposes (the paper's N)."""
    seed: int = 0
    """Seed of the generator."""
    box_method: Literal["upright", "pca", "min_volume"] = "upright"
    """Box fit: `pca` is the paper's, `upright` uses the known direction of gravity."""
    k_faces: int = 2
    """Number of faces nearest to the camera that a grasp may approach (the paper's k)."""
    alpha: float = 0.85
    """Weight of the alignment against the generator's score (the paper's α), among grasps of equal value to arm
    and gripper (`planner.reachability`)."""
    scoring: Path | None = None
    """A file of `./z1 tune`, whose box, faces, weights and thresholds replace `box_method`, `k_faces`, `alpha`
    and, if it has a head, the weights of `planner.reachability`; None = those set here."""
    speed: float = 0.5
    """Fraction of the arm's speed, acceleration and jerk limits that motions use, in (0, 1]."""
    jaw_home: float = -1.0
    """Jaw angle in the observation posture [rad]; 0 is closed."""
    jaw_empty: float = -0.03
    """Jaw angle beyond which a closed gripper is empty [rad]."""
    held_torque_nm: float = 1.0
    """Minimum gripper torque of a held object [Nm]."""
    hold_s: float = 1.0
    """Duration for which the lifted object must be held [s]."""
    attempts: int = 2
    """Maximum number of picks while the jaws end up empty, each from a new frame."""
    frame_timeout_s: float = 5.0
    """Timeout of a camera frame [s]."""
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    """Clouds, filters and the table."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Stand-off, lift, clearances."""
    executor: ExecutorConfig = field(default_factory=ExecutorConfig)
    """Streaming of trajectories to the servo."""

    def __post_init__(self) -> None:
        _require(self.detector in DETECTORS, "detector", repr(self.detector), " or ".join(DETECTORS))
        split_generator_name(self.generator)
        _require(1 <= self.n_candidates <= 20_000, "n_candidates", self.n_candidates, "1 to 20000")
        _require(
            self.box_method in ("upright", "pca", "min_volume"),
            "box_method",
            self.box_method,
            "upright, pca or min_volume",
        )
        _require(1 <= self.k_faces <= 6, "k_faces", self.k_faces, "1 to 6")
        _require(0.0 <= self.alpha <= 1.0, "alpha", self.alpha, "0 to 1")
        _require(0.0 < self.speed <= 1.0, "speed", self.speed, "above 0, up to 1")
        _require(-1.5707 <= self.jaw_home <= 0.0, "jaw_home", self.jaw_home, "-1.5707 (open) to 0 (closed) rad")
        _require(-1.5707 <= self.jaw_empty <= 0.0, "jaw_empty", self.jaw_empty, "-1.5707 to 0 rad")
        _require(0.0 <= self.held_torque_nm < 30.0, "held_torque_nm", self.held_torque_nm, "0 to 30 Nm")
        _require(0.0 <= self.hold_s <= 60.0, "hold_s", self.hold_s, "0 to 60 s")
        _require(1 <= self.attempts <= 20, "attempts", self.attempts, "1 to 20")
        _require(0.0 < self.frame_timeout_s <= 60.0, "frame_timeout_s", self.frame_timeout_s, "above 0, up to 60 s")


def load_config(path: Path | None = None) -> RuntimeConfig:
    """Return the defaults with the values of the YAML file at `path` put over them.

    Raises:
        ConfigError: the file is missing, is not YAML, or has an unknown key or an invalid value.
    """
    if path is None:
        return RuntimeConfig()
    from hal.base.files import read_yaml

    return config_from(read_yaml(path, "the configuration") or {}, str(path))


def config_from(data: Mapping[str, Any], where: str) -> RuntimeConfig:
    """Return the defaults with the values of `data` put over them, as `asdict`, YAML and JSON give them.

    Raises:
        ConfigError: an unknown key or an invalid value; the message begins with `where`.
    """
    from hal.base.files import structure

    return structure(RuntimeConfig, data, where)


def with_detector(
    config: RuntimeConfig, detector: str | None, weights: Path | None, crop: Literal["mask", "box"] | None
) -> RuntimeConfig:
    """Return `config` with what a command line says of the detector; weights without a name are for `yolo`.

    Raises:
        ValueError: no detector is called that.
    """
    if weights is not None:
        config = replace(config, detector="yolo", yolo=replace(config.yolo, weights=weights))
    if detector is not None:
        config = replace(config, detector=detector)
    return config if crop is None else replace(config, perception=replace(config.perception, crop=crop))


def with_generator(config: RuntimeConfig, generator: str | None, weights: Path | None) -> RuntimeConfig:
    """Return `config` with what a command line says of the grasp generator; weights alone tell whose they are.

    Raises:
        ValueError: no generator is called that, or has such weights.
    """
    if weights is not None:
        name = generator_for(weights)
        if name in split_generator_name(config.generator):
            name = config.generator  # as it was configured, such as a union
        options = replace(config.generator_options, weights=weights)
        config = replace(config, generator=name, generator_options=options)
    return config if generator is None else replace(config, generator=generator)


def ranking_of(config: RuntimeConfig) -> Ranking:
    """Return the numbers that `config` ranks by: those of its scoring file, or else its own.

    Raises:
        ScoringError: the file cannot be used.
    """
    if config.scoring is not None:
        return load_scoring(config.scoring).full
    return hand_set(config)


def hand_set(config: RuntimeConfig) -> Ranking:
    """Return the numbers that stand in `config` itself."""
    return Ranking(k_faces=config.k_faces, alpha=config.alpha, box_method=config.box_method)


def save_config(config: RuntimeConfig, path: Path) -> None:
    """Write `config` as YAML that `load_config` reads back to an equal one."""
    from hal.base.files import atomic_write, plain

    atomic_write(path, yaml.safe_dump(plain(asdict(config)), sort_keys=False))


def _require(ok: bool, name: str, seen: object, allowed: str) -> None:
    if not ok:
        raise InvalidValueError(f"{name} is {seen}; allowed is {allowed}.")

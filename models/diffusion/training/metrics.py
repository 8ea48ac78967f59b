"""Metrics of a generator's grasps for one view, and means over many views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hal.base.transforms import inverse
from models.diffusion.training.dynamics_test import simulate_grasps
from models.diffusion.training.grippers import AnyGripper, ParallelGripperSpec
from models.diffusion.training.labels import GraspCheck, check_grasps, find_grasps
from models.diffusion.training.solids import Solid
from models.obb.mvbb import fit_obb, rank_grasps
from models.types import GraspGenerator, GraspSet

_COVERAGE_M, _COVERAGE_RAD = 0.02, np.radians(25.0)
_FRONT_RAD = np.radians(35.0)
_MAX_GROUND_TRUTH = 400  # bounds the (G, N) comparison of the coverage
_TOP = (100, 10, 1)


@runtime_checkable
class _Oversampling(Protocol):
    """Generator that drops some of the grasps that it draws."""

    def draw(self, points: np.ndarray, n: int, seed: int) -> GraspSet: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudMetrics:
    """Metrics of the grasps for one cloud."""

    family: str
    raw_valid: np.ndarray
    """(N,) bool, validity of the generator's own grasps, none dropped."""
    raw_scores: np.ndarray
    """(N,) scores of the same."""
    raw_coverage: float
    """Ratio of the ground truth that has a valid one of those near it."""
    valid: np.ndarray
    """(N,) bool, validity of the grasps of `sample`, best score first."""
    coverage: float
    """As `raw_coverage`, of those."""
    frontal: np.ndarray
    """(N,) bool, approach within 35° of the view ray."""
    before_faces: np.ndarray
    """(N,) bool, accepted by the box: the approach is at one of its two nearest faces."""
    width_errors_m: np.ndarray
    """(N,) stated minus true distance between the contacts; NaN where a pad touches nothing."""
    offsets_m: np.ndarray
    """(N,) distance of the contacts' middle from the grasp's origin [m]."""
    simulated_valid: np.ndarray
    """(K,) bool, success of some valid grasps in the dynamics test."""
    simulated_invalid: np.ndarray
    """(K,) bool, the same for grasps that close on the object outside the friction cone."""
    simulated_best: np.ndarray
    """(0 or 1,) bool, the same for the grasp with the highest score."""


def measure_cloud(
    generator: GraspGenerator,
    gripper: AnyGripper,
    solid: Solid,
    points: np.ndarray,
    *,
    T_camera_object: np.ndarray,
    samples: int,
    simulations: int = 0,
) -> CloudMetrics:
    """Return the metrics of `generator`'s grasps for one view; `simulations` of each label are simulated."""
    T_object_camera = inverse(T_camera_object)
    ground_truth = find_grasps(solid, gripper, np.random.default_rng(1))[0][:_MAX_GROUND_TRUTH]
    grasps = _sample(generator, points, samples)
    raw = generator.draw(points, samples, 0) if isinstance(generator, _Oversampling) else grasps
    T, T_raw = T_object_camera @ grasps.T_camera_grasps, T_object_camera @ raw.T_camera_grasps
    check = check_grasps(solid, T, gripper, grasps.widths_m)
    raw_valid = check_grasps(solid, T_raw, gripper, raw.widths_m).valid
    ray = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
    kept = np.zeros(len(grasps), dtype=bool)
    # The paper's filter: box by PCA, as no up direction is given, and k = 2
    kept[rank_grasps(grasps, fit_obb(points), k=2).indices] = True
    return CloudMetrics(
        family=solid.family,
        raw_valid=raw_valid,
        raw_scores=raw.scores,
        raw_coverage=_coverage(ground_truth, T_raw[raw_valid]),
        valid=check.valid,
        coverage=_coverage(ground_truth, T[check.valid]),
        frontal=grasps.T_camera_grasps[:, :3, 2] @ ray > np.cos(_FRONT_RAD),
        before_faces=kept,
        width_errors_m=grasps.widths_m - check.widths_m,
        offsets_m=check.offsets_m,
        **_simulate(solid, T, check, gripper, simulations),
    )


def _sample(generator: GraspGenerator, points: np.ndarray, samples: int) -> GraspSet:
    try:
        return generator.sample(points, samples, 0)
    except ValueError:  # raised by the antipodal sampler when it finds none: a result here
        return GraspSet(T_camera_grasps=np.zeros((0, 4, 4)), scores=np.zeros(0), widths_m=np.zeros(0))


def _simulate(solid: Solid, T: np.ndarray, check: GraspCheck, gripper: AnyGripper, count: int) -> dict[str, np.ndarray]:
    """Return the success in the dynamics test of some valid grasps, some outside the cone, and the best."""
    rng = np.random.default_rng(2)
    outside_cone = check.free & ~check.antipodal & np.isfinite(check.widths_m)
    picks = {
        "simulated_valid": rng.permutation(np.flatnonzero(check.valid))[:count],
        "simulated_invalid": rng.permutation(np.flatnonzero(outside_cone))[:count],
        "simulated_best": np.arange(min(count, 1, len(T))),
    }
    if not isinstance(gripper, ParallelGripperSpec):  # the dynamics test models parallel fingers only
        picks = dict.fromkeys(picks, np.zeros(0, dtype=int))
    return {key: simulate_grasps(solid, T[pick], check[pick], gripper) for key, pick in picks.items()}  # pyright: ignore[reportArgumentType]


def _coverage(ground_truth: np.ndarray, found: np.ndarray) -> float:
    """Return the ratio of `ground_truth` (G, 4, 4) with some `found` (N, 4, 4) within 2 cm, and 25° of both axes."""
    if not len(found) or not len(ground_truth):
        return 0.0
    distance = np.linalg.norm(ground_truth[:, None, :3, 3] - found[None, :, :3, 3], axis=-1)
    approach = ground_truth[:, :3, 2] @ found[:, :3, 2].T
    # Either closing direction is the same grasp
    closing = np.abs(ground_truth[:, :3, 1] @ found[:, :3, 1].T)
    near = (distance < _COVERAGE_M) & (approach > np.cos(_COVERAGE_RAD)) & (closing > np.cos(_COVERAGE_RAD))
    return float(near.any(axis=1).mean())


def summarise(clouds: list[CloudMetrics]) -> dict:
    """Return means over clouds, and the discriminator's AUC and calibration over all raw grasps."""
    valid, scores = np.concatenate([c.raw_valid for c in clouds]), np.concatenate([c.raw_scores for c in clouds])
    errors = np.concatenate([np.abs(c.width_errors_m[c.valid]) for c in clouds])
    offsets = np.concatenate([np.abs(c.offsets_m[c.valid]) for c in clouds])
    raw, returned = [_ratio(c.raw_valid) for c in clouds], [_ratio(c.valid) for c in clouds]
    best = {f"top{k}": [_ratio(c.valid[:k]) for c in clouds] for k in _TOP}
    kept = [int(c.before_faces.sum()) for c in clouds]
    both = [(c.raw_scores, c.raw_valid) for c in clouds if 0 < c.raw_valid.sum() < len(c.raw_valid)]
    return {
        "clouds": len(clouds),
        "raw": _mean(raw),
        "returned": _mean(returned),
        **{key: _mean(values) for key, values in best.items()},
        "raw_coverage": _mean([c.raw_coverage for c in clouds]),
        "coverage": _mean([c.coverage for c in clouds]),
        "auc": round(area_under_curve(scores, valid), 3),
        "auc_within_cloud": _mean([area_under_curve(s, v) for s, v in both]),
        "frontal_ratio": _mean([_ratio(c.frontal) for c in clouds]),
        "frontal_valid": _mean(np.concatenate([c.valid[c.frontal] for c in clouds])),
        "clouds_with_5_frontal_valid": _mean([np.sum(c.valid & c.frontal) >= 5 for c in clouds]),
        "mvbb_keeps_median": int(np.median(kept)),
        "mvbb_keeps_min": min(kept),
        "mvbb_keeps_min_valid": min(int(np.sum(c.valid & c.before_faces)) for c in clouds),
        "median_width_error_m": round(float(np.median(errors)), 4) if len(errors) else None,
        "median_offset_m": round(float(np.median(offsets)), 4) if len(offsets) else None,
        "simulated": {
            key: {"tried": len(held), "held": int(held.sum())}
            for key in ("valid", "invalid", "best")
            if len(held := np.concatenate([getattr(c, f"simulated_{key}") for c in clouds]))
        },
        "raw_by_family": _by_family(clouds, raw),
        "returned_by_family": _by_family(clouds, returned),
        "top1_by_family": _by_family(clouds, best["top1"]),
        "calibration": calibrate(scores, valid),
    }


def area_under_curve(scores: np.ndarray, valid: np.ndarray) -> float:
    """Return the chance that a valid grasp scores above an invalid one (area under the ROC curve)."""
    ranks = np.argsort(np.argsort(scores)) + 1.0
    good, bad = valid.sum(), (~valid).sum()
    return float((ranks[valid].sum() - good * (good + 1) / 2) / (good * bad)) if good and bad else float("nan")


def calibrate(scores: np.ndarray, valid: np.ndarray) -> list[dict]:
    """Return, for ten bands of score, the number of grasps, their mean score and their valid ratio."""
    band = np.clip((scores * 10).astype(int), 0, 9)
    return [
        {"n": int((band == b).sum()), "score": _mean(scores[band == b]), "valid": _mean(valid[band == b])}
        for b in range(10)
        if (band == b).any()
    ]


def _by_family(clouds: list[CloudMetrics], values: list[float]) -> dict[str, float]:
    families = sorted({c.family for c in clouds})
    return {f: _mean([v for v, c in zip(values, clouds, strict=True) if c.family == f]) for f in families}


def _ratio(mask: np.ndarray) -> float:
    return float(mask.mean()) if len(mask) else 0.0


def _mean(values) -> float:
    return round(float(np.mean(values)), 3) if len(values) else float("nan")

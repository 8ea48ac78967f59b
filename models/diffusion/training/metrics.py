"""What a generator's grasps for one view are worth, and means over many views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from models.diffusion.training.dynamics_test import simulate_grasps
from models.diffusion.training.labels import GraspCheck, ParallelGripperSpec, AnyGripper, check_grasps, find_grasps
from models.diffusion.training.solids import Solid
from models.obb.mvbb import fit_obb, rank_grasps
from models.types import GraspGenerator, GraspSet

_COVERAGE_M, _COVERAGE_RAD = 0.02, np.radians(25.0)
_FRONT_RAD = np.radians(35.0)
_TRUTHS = 400
_BEST = (100, 10, 1)


@runtime_checkable
class _DrawsMore(Protocol):
    """A generator that keeps some of what it draws back."""

    def draw(self, points: np.ndarray, n: int, seed: int) -> GraspSet: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudResult:
    """What one cloud's grasps were worth."""

    family: str
    raw_valid: np.ndarray
    """(N,) bool, the generator's own grasps, none kept back."""
    raw_scores: np.ndarray
    """(N,)."""
    raw_coverage: float
    """Share of the ground truth with a valid one of those close by."""
    valid: np.ndarray
    """(N,) bool, what `sample` returned, best score first."""
    coverage: float
    """As `raw_coverage`, of those."""
    frontal: np.ndarray
    """(N,) bool, approach within 35° of the view ray."""
    before_faces: np.ndarray
    """(N,) bool, what the minimum-volume box lets through: they come at one of its two nearest faces."""
    width_errors_m: np.ndarray
    """(N,) stated minus true distance between the contacts; NaN where a pad touches nothing."""
    offsets_m: np.ndarray
    """(N,) how far off the middle the object is held."""
    simulated_valid: np.ndarray
    """(K,) bool, which of some valid grasps held when shaken in dynamics."""
    simulated_invalid: np.ndarray
    """(K,) bool, the same for grasps that close on the object outside the friction cone."""
    simulated_best: np.ndarray
    """(0 or 1,) bool, whether the grasp that scored highest held."""


def measure_cloud(
    generator: GraspGenerator,
    gripper: AnyGripper,
    solid: Solid,
    points: np.ndarray,
    *,
    T_camera_object: np.ndarray,
    samples: int,
    simulated: int = 0,
) -> CloudResult:
    """Return what `generator`'s grasps for one view are worth; `simulated` of each verdict are tried in dynamics."""
    T_object_camera = np.linalg.inv(T_camera_object)
    truth = find_grasps(solid, gripper, np.random.default_rng(1))[0][:_TRUTHS]
    grasps = _sample(generator, points, samples)
    raw = generator.draw(points, samples, 0) if isinstance(generator, _DrawsMore) else grasps
    T, T_raw = T_object_camera @ grasps.T_camera_grasps, T_object_camera @ raw.T_camera_grasps
    check = check_grasps(solid, T, gripper, grasps.widths_m)
    raw_valid = check_grasps(solid, T_raw, gripper, raw.widths_m).valid
    ray = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
    kept = np.zeros(len(grasps), dtype=bool)
    kept[rank_grasps(grasps, fit_obb(points), k=2).indices] = True
    return CloudResult(
        family=solid.family,
        raw_valid=raw_valid,
        raw_scores=raw.scores,
        raw_coverage=_coverage(truth, T_raw[raw_valid]),
        valid=check.valid,
        coverage=_coverage(truth, T[check.valid]),
        frontal=grasps.T_camera_grasps[:, :3, 2] @ ray > np.cos(_FRONT_RAD),
        before_faces=kept,
        width_errors_m=grasps.widths_m - check.widths_m,
        offsets_m=check.offsets_m,
        **_simulate(solid, T, check, gripper, simulated),
    )


def _sample(generator: GraspGenerator, points: np.ndarray, samples: int) -> GraspSet:
    try:
        return generator.sample(points, samples, 0)
    except ValueError:  # the antipodal sampler says so when it finds none: that is a result here
        return GraspSet(T_camera_grasps=np.zeros((0, 4, 4)), scores=np.zeros(0), widths_m=np.zeros(0))


def _simulate(solid: Solid, T: np.ndarray, check: GraspCheck, gripper: AnyGripper, count: int) -> dict[str, np.ndarray]:
    """Return which grasps hold when shaken: some valid ones, some that close askew, and the best."""
    rng = np.random.default_rng(2)
    askew = check.free & ~check.antipodal & np.isfinite(check.widths_m)
    picks = {
        "simulated_valid": rng.permutation(np.flatnonzero(check.valid))[:count],
        "simulated_invalid": rng.permutation(np.flatnonzero(askew))[:count],
        "simulated_best": np.arange(min(count, 1, len(T))),
    }
    if not isinstance(gripper, ParallelGripperSpec):  # a beak's jaws are not modelled in dynamics
        picks = dict.fromkeys(picks, np.zeros(0, dtype=int))
    return {key: simulate_grasps(solid, T[pick], check[pick], gripper) for key, pick in picks.items()}  # pyright: ignore[reportArgumentType]


def _coverage(truth: np.ndarray, found: np.ndarray) -> float:
    """Return the share of `truth` (G, 4, 4) that some `found` (N, 4, 4) meets within 2 cm, and 25° about both axes."""
    if not len(found) or not len(truth):
        return 0.0
    gap = np.linalg.norm(truth[:, None, :3, 3] - found[None, :, :3, 3], axis=-1)
    approach = truth[:, :3, 2] @ found[:, :3, 2].T
    closing = np.abs(truth[:, :3, 1] @ found[:, :3, 1].T)
    near = (gap < _COVERAGE_M) & (approach > np.cos(_COVERAGE_RAD)) & (closing > np.cos(_COVERAGE_RAD))
    return float(near.any(axis=1).mean())


def summarise(clouds: list[CloudResult]) -> dict:
    """Return means over clouds, and the discriminator's AUC and calibration over all raw grasps."""
    valid, scores = np.concatenate([c.raw_valid for c in clouds]), np.concatenate([c.raw_scores for c in clouds])
    errors = np.concatenate([np.abs(c.width_errors_m[c.valid]) for c in clouds])
    offsets = np.concatenate([np.abs(c.offsets_m[c.valid]) for c in clouds])
    raw, returned = [_share(c.raw_valid) for c in clouds], [_share(c.valid) for c in clouds]
    best = {f"top{k}": [_share(c.valid[:k]) for c in clouds] for k in _BEST}
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
        "frontal_ratio": _mean([_share(c.frontal) for c in clouds]),
        "frontal_valid": _mean(np.concatenate([c.valid[c.frontal] for c in clouds])),
        "clouds_with_5_frontal_valid": _mean([np.sum(c.valid & c.frontal) >= 5 for c in clouds]),
        "mvbb_keeps_median": int(np.median(kept)),
        "mvbb_keeps_least": min(kept),
        "mvbb_keeps_least_valid": min(int(np.sum(c.valid & c.before_faces)) for c in clouds),
        "median_width_error_m": round(float(np.median(errors)), 4) if len(errors) else None,
        "median_offset_m": round(float(np.median(offsets)), 4) if len(offsets) else None,
        "simulated": {
            key: {"tried": len(held), "held": int(held.sum())}
            for key in ("valid", "invalid", "best")
            if len(held := np.concatenate([getattr(c, f"shaken_{key}") for c in clouds]))
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
    """Return, for ten bands of score, how many grasps fall in, their mean score and the share that is valid."""
    band = np.clip((scores * 10).astype(int), 0, 9)
    return [
        {"n": int((band == b).sum()), "score": _mean(scores[band == b]), "valid": _mean(valid[band == b])}
        for b in range(10)
        if (band == b).any()
    ]


def _by_family(clouds: list[CloudResult], values: list[float]) -> dict[str, float]:
    families = sorted({c.family for c in clouds})
    return {f: _mean([v for v, c in zip(values, clouds, strict=True) if c.family == f]) for f in families}


def _share(mask: np.ndarray) -> float:
    return float(mask.mean()) if len(mask) else 0.0


def _mean(values) -> float:
    return round(float(np.mean(values)), 3) if len(values) else float("nan")

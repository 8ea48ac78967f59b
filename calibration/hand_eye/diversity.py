"""Observability of the hand-eye transform: rotations of the arm, large enough and about more than one axis."""

from __future__ import annotations

import numpy as np

from calibration.errors import CalibrationError, CalibrationWarning
from hal.base.transforms import rotation_vectors

MIN_POSES = 5
"""Fewer samples are rejected: no redundancy would be left to estimate their error."""
GOOD_POSES = 10
"""Fewer samples get a warning."""

_MIN_TURN_DEG, _GOOD_TURN_DEG = 3.0, 10.0  # rms rotation between samples about the best axis
_MIN_SECOND_DEG, _GOOD_SECOND_DEG = 1.5, 6.0  # the same about the second best


def compute_rotation_spread_deg(Ts_anchor_mount: np.ndarray) -> np.ndarray:
    """Return the rms rotation (3,) between samples about their principal axes, descending [°]."""
    between = _rotations_between(Ts_anchor_mount)
    return np.degrees(np.sqrt(np.linalg.eigvalsh(between.T @ between / len(between))[::-1].clip(0.0)))


def compute_diversity(Ts_anchor_mount: np.ndarray) -> float:
    """Return a score 0 … 1 of how well the rotations determine the camera's position in its weakest direction.

    A motion with the rotation R depends on the camera's position p through (R − 1) p. The score is the root mean square
    of that over the motions between all samples, minimised over unit vectors p; 1 is reached with 0.5, the value of
    rotations by 30° about every axis.
    """
    between = _rotations_between(Ts_anchor_mount)
    angle = np.linalg.norm(between, axis=1)
    axis = between / np.maximum(angle, 1e-12)[:, None]
    information = 2.0 * (1.0 - np.cos(angle))[:, None, None] * (np.eye(3) - axis[:, :, None] * axis[:, None, :])
    return float(min(1.0, np.sqrt(np.linalg.eigvalsh(information.mean(axis=0))[0].clip(0.0)) / 0.5))


def check_diversity(Ts_anchor_mount: np.ndarray) -> list[CalibrationWarning]:
    """Return warnings about too few or too similar poses (N, 4, 4).

    Raises:
        CalibrationError: `too_few_poses`, `too_similar_poses`, `planar_rotations`: no calibration is possible.
    """
    n = len(Ts_anchor_mount)
    if n < MIN_POSES:
        raise CalibrationError(
            f"samples: too few are usable ({n}, needed from {MIN_POSES}, good {2 * GOOD_POSES}). Take more.",
            code="too_few_poses",
        )
    found = []
    if n < GOOD_POSES:
        message = (
            f"samples: {n} are usable, {GOOD_POSES} is the minimum for reliable figures, {2 * GOOD_POSES} are good."
        )
        found.append(CalibrationWarning(code="too_few_poses", message=message))
    first, second, _ = compute_rotation_spread_deg(Ts_anchor_mount)
    similar = (
        f"samples: the poses are too similar (rms rotation {first:.1f}°, good from {2 * _GOOD_TURN_DEG:g}°). View "
        "the board "
        "from more sides and roll the wrist."
    )
    planar = (
        f"samples: the rotations are about nearly one axis ({first:.1f}° about it, {second:.1f}° about any "
        "other), which "
        "leaves the camera's position along it undetermined. Turn the wrist about a second axis by 20° or more."
    )
    if first < _MIN_TURN_DEG:
        raise CalibrationError(similar, code="too_similar_poses")
    if second < _MIN_SECOND_DEG:
        raise CalibrationError(planar, code="planar_rotations")
    if first < _GOOD_TURN_DEG:
        found.append(CalibrationWarning(code="too_similar_poses", message=similar))
    elif second < _GOOD_SECOND_DEG:
        found.append(CalibrationWarning(code="planar_rotations", message=planar))
    return found


def _rotations_between(Ts_anchor_mount: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (P, 3) between all pairs of samples, in mount axes [rad]."""
    first, second = np.triu_indices(len(Ts_anchor_mount), 1)
    R = np.swapaxes(Ts_anchor_mount[first, :3, :3], 1, 2) @ Ts_anchor_mount[second, :3, :3]
    return rotation_vectors(R)

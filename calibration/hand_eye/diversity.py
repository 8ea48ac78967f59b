"""Whether the arm turned enough, and about more than one axis, for a hand-eye to be seen at all."""

from __future__ import annotations

import numpy as np

from calibration.errors import CalibrationError, CalibrationWarning
from calibration.transforms import rotation_vectors

MIN_POSES = 5
"""Fewer samples are refused: nothing would be left to judge them by."""
GOOD_POSES = 10
"""Fewer samples get a warning."""

_MIN_TURN_DEG, _GOOD_TURN_DEG = 3.0, 10.0  # rms rotation between samples about the best axis
_MIN_SECOND_DEG, _GOOD_SECOND_DEG = 1.5, 6.0  # the same about the second best


def turns_deg(Ts_anchor_mount: np.ndarray) -> np.ndarray:
    """Return the rms rotation (3,) between samples about their principal axes, greatest first [°]."""
    between = _rotations_between(Ts_anchor_mount)
    return np.degrees(np.sqrt(np.linalg.eigvalsh(between.T @ between / len(between))[::-1].clip(0.0)))


def diversity(Ts_anchor_mount: np.ndarray) -> float:
    """Return 0 … 1: how well the rotations pin down the camera's position in its weakest direction.

    A motion with the rotation R shows the camera's position p through (R − 1) p. The score is the root mean square of
    that over the motions between all samples, for the unit p it shows least; 1 is reached with 0.5, as rotations of
    30° about every axis have it.
    """
    between = _rotations_between(Ts_anchor_mount)
    angle = np.linalg.norm(between, axis=1)
    axis = between / np.maximum(angle, 1e-12)[:, None]
    shown = 2.0 * (1.0 - np.cos(angle))[:, None, None] * (np.eye(3) - axis[:, :, None] * axis[:, None, :])
    return float(min(1.0, np.sqrt(np.linalg.eigvalsh(shown.mean(axis=0))[0].clip(0.0)) / 0.5))


def check_diversity(Ts_anchor_mount: np.ndarray) -> list[CalibrationWarning]:
    """Return warnings about too few or too similar poses (N, 4, 4).

    Raises:
        CalibrationError: `too_few_poses`, `too_similar_poses`, `planar_rotations`: no calibration comes of these.
    """
    n = len(Ts_anchor_mount)
    if n < MIN_POSES:
        raise CalibrationError(
            "too_few_poses",
            f"{n} usable samples; at least {MIN_POSES} are needed and {2 * GOOD_POSES} are good: take more.",
        )
    found = []
    if n < GOOD_POSES:
        message = f"{n} usable samples; {GOOD_POSES} is the least for a figure to trust, {2 * GOOD_POSES} are good."
        found.append(CalibrationWarning(code="too_few_poses", message=message))
    first, second, _ = turns_deg(Ts_anchor_mount)
    similar = (
        f"the samples are alike: they turn by {first:.1f}° (rms) against each other, {2 * _GOOD_TURN_DEG:g}° are good; "
        "look at the board from more sides and roll the wrist."
    )
    planar = (
        f"all rotations are about nearly one axis ({first:.1f}° about it, {second:.1f}° about any other): the camera's "
        "position along that axis cannot be seen; turn the wrist about a second axis by 20° and more."
    )
    if first < _MIN_TURN_DEG:
        raise CalibrationError("too_similar_poses", similar)
    if second < _MIN_SECOND_DEG:
        raise CalibrationError("planar_rotations", planar)
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

"""Which samples to believe: bad ones, a board that moved between two of them, poses given in a wrong order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from calibration.hand_eye.closed_forms import robust_start
from calibration.hand_eye.pose_fit import (
    NoiseLevels,
    PoseData,
    PoseFit,
    covariances,
    errors,
    estimate_noise,
    leave_one_out,
    solve,
    squared_distances,
)
from calibration.transforms import distance, inverse

_FAR = 25.0  # squared distance beyond which a sample has no weight: one in 3000 good ones is as far
_MEDIAN = 5.348  # of chi square with 6 degrees of freedom
_FALSE_ALARM = 1e-4  # probability that a good sample is dropped
_MOVE_GAIN = 50.0  # by how much two places must explain the samples better than one, in squared distances
_LEAST_GROUP = 3  # samples on either side of a move
_LEAST_MOVE_MM, _LEAST_MOVE_DEG = 1.0, 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Belief:
    """A fit to the samples that agree."""

    fit: PoseFit
    """The unknowns, from the samples kept."""
    noise: NoiseLevels
    """Scatter of the arm."""
    kept: np.ndarray
    """(N,) bool."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """The board lay elsewhere from one sample on."""

    first: int
    """Index of the first sample that sees it elsewhere."""
    mm: float
    """How far it moved [mm]."""
    deg: float
    """How far it turned [°]."""


def start_fit(data: PoseData) -> PoseFit:
    """Return a fit of most samples to start from."""
    T_mount_camera, T_anchor_board, _ = robust_start(data.Ts_anchor_mount, data.Ts_camera_board)
    return PoseFit(
        T_mount_camera=T_mount_camera, Ts_anchor_board=T_anchor_board[None], place=np.zeros(len(data), dtype=int)
    )


def robust_solve(data: PoseData, fit: PoseFit, noise: NoiseLevels, *, rounds: int = 15) -> tuple[PoseFit, np.ndarray]:
    """Return the fit to the samples that agree (Tukey's weights, free scale), and the squared distances (N,) of all."""
    swallowed = 6 * len(data) / (6 * len(data) - 6 - 6 * len(fit.Ts_anchor_board))
    for _ in range(rounds):
        C = covariances(data, fit, noise)
        d2 = squared_distances(errors(data, fit), C)
        spread = max(1e-9, swallowed * float(np.median(d2)) / _MEDIAN)
        weights = np.clip(1.0 - d2 / (_FAR * spread), 0.0, None) ** 2
        before, (fit, _) = fit, solve(data, fit, C, weights, free_scale=True, rounds=1)
        if max(np.max(part) for part in distance(before.T_mount_camera, fit.T_mount_camera)) < 1e-4:
            break
    return fit, squared_distances(errors(data, fit), covariances(data, fit, noise))


def believe(data: PoseData, fit: PoseFit, *, free_scale: bool = True) -> Belief:
    """Return the fit to all samples that agree with each other.

    A sample is judged by the solution of all others, so that a bad one cannot vouch for itself; one dropped in an
    early round may come back.
    """
    robust, d2 = robust_solve(data, fit, NoiseLevels())
    fit = robust if free_scale else replace(robust, scale=fit.scale)
    kept = d2 < _FAR * max(1e-9, float(np.median(d2)) / _MEDIAN) * 2.0
    noise = NoiseLevels()
    seen: set[bytes] = set()
    while kept.tobytes() not in seen:
        seen.add(kept.tobytes())
        for _ in range(2):  # the errors tell the noise, and the noise weighs the errors
            noise = estimate_noise(data, fit, kept, noise, free_scale=free_scale)
            C = covariances(data, fit, noise)
            fit, _ = solve(data, fit, C, kept.astype(float), free_scale=free_scale)
        d2 = squared_distances(*leave_one_out(data, fit, C, kept, free_scale=free_scale))
        limit = 6.0 * f_distribution.ppf(1.0 - _FALSE_ALARM, 6, max(3 * (int(kept.sum()) - 2), 3))
        kept = d2 < limit
    return Belief(fit=fit, noise=noise, kept=kept)


def find_move(data: PoseData, fit: PoseFit) -> Move | None:
    """Return where in the sequence the board was moved, if it was."""
    noise = NoiseLevels()
    gain, best, index = _best_split(data, fit, noise)
    if best is None or gain < 0.2 * _MOVE_GAIN:
        return None
    near = squared_distances(errors(data, best), covariances(data, best, noise)) < _FAR
    estimated = estimate_noise(data, best, near, noise, free_scale=True)
    noise = NoiseLevels(arm_m=max(estimated.arm_m, 1e-4), arm_rad=max(estimated.arm_rad, 2e-4))
    gain, best, index = _best_split(data, fit, noise)
    if best is None or gain < _MOVE_GAIN:
        return None
    mm, deg = distance(*best.Ts_anchor_board)
    if mm < max(_LEAST_MOVE_MM, 3e3 * noise.arm_m) and deg < max(_LEAST_MOVE_DEG, np.degrees(3 * noise.arm_rad)):
        return None
    return Move(first=index, mm=float(mm), deg=float(deg))


def _best_split(data: PoseData, fit: PoseFit, noise: NoiseLevels) -> tuple[float, PoseFit | None, int]:
    """Return how much better two places explain the samples, with the fit and the first sample of the second."""
    _, d2 = robust_solve(data, fit, noise)
    one = np.minimum(d2, _FAR).sum()
    gain, best, index = 0.0, None, 0
    for first in range(_LEAST_GROUP, len(data) - _LEAST_GROUP + 1):
        place = (np.arange(len(data)) >= first).astype(int)
        boards = data.Ts_anchor_mount @ fit.T_mount_camera @ data.Ts_camera_board
        places = np.stack([_middle(boards[place == g]) for g in range(2)])
        two, d2 = robust_solve(data, replace(fit, Ts_anchor_board=places, place=place), noise, rounds=5)
        near = d2 < _FAR
        if min(near[:first].sum(), near[first:].sum()) < _LEAST_GROUP:
            continue
        if one - np.minimum(d2, _FAR).sum() > gain:
            gain, best, index = float(one - np.minimum(d2, _FAR).sum()), two, first
    return gain, best, index


def _middle(boards: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of those given that is nearest to the others."""
    mm, deg = distance(boards[:, None], boards[None])
    return boards[np.argmin(np.median(mm + 5.0 * deg, axis=1))]


def explain_order(Ts_anchor_mount: np.ndarray, Ts_camera_board: np.ndarray) -> str | None:
    """Return which mistake in the poses would explain samples that do not fit together; None when none does."""
    A, B = Ts_anchor_mount, Ts_camera_board
    mistakes = {
        "the arm's poses are inverted (T_flange_base was given for T_base_flange, or the other setup is meant)": (
            inverse(A),
            B,
        ),
        "the board's poses are inverted (T_board_camera was given for T_camera_board)": (A, inverse(B)),
        "one of the two lists runs backwards": (A, B[::-1]),
        "each picture belongs to the arm's pose before": (A[:-1], B[1:]),
        "each picture belongs to the arm's pose after": (A[1:], B[:-1]),
    }
    as_given = robust_start(A, B)[2]
    explained = {what: robust_start(*poses)[2] for what, poses in mistakes.items()}
    best = min(explained, key=lambda what: explained[what])
    return best if explained[best] < 0.2 * as_given else None

"""Which of the grasps that were drawn are given out: good ones, and of each kind some."""

from __future__ import annotations

import numpy as np

_CELL_M = 0.03
_N_APPROACHES = 32
_N_CLOSINGS = 8


def choose_grasps(T: np.ndarray, scores: np.ndarray, n: int) -> np.ndarray:
    """Return the indices (n,) of the grasps worth most, best score first.

    A grasp is worth its score, and once more its score times the chance that nothing better of its kind holds: so the
    best of each kind goes before the twentieth of another, and coverage does not suffer for a higher share that holds.
    Of one kind are grasps that approach and close alike within some 36° and lie in the same cube of 3 cm.

    Args:
        T: (M, 4, 4) grasps, M ≥ n.
        scores: (M,) chance that each holds.
        n: how many to choose.
    """
    order = np.argsort(-scores, kind="stable")
    chances = scores[order]
    _, kind = np.unique(_kinds(T[order]), axis=0, return_inverse=True)
    nothing_better = np.ones(len(order))
    for k in range(kind.max() + 1):
        same = np.flatnonzero(kind == k)
        nothing_better[same[1:]] = np.cumprod(1.0 - chances[same[:-1]])
    chosen = np.argsort(-chances * (1.0 + nothing_better), kind="stable")[:n]
    return order[np.sort(chosen)]


def _kinds(T: np.ndarray) -> np.ndarray:
    """Return the rows (M, 5) that grasps of one kind share."""
    approach = np.argmax(T[:, :3, 2] @ _directions(_N_APPROACHES).T, axis=1)
    closing = np.argmax(np.abs(T[:, :3, 1] @ _directions(2 * _N_CLOSINGS).T), axis=1)
    cube = np.floor(T[:, :3, 3] / _CELL_M).astype(int)
    return np.column_stack([approach, closing, cube])


def _directions(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) spread evenly over the sphere along a spiral."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    rho = np.sqrt(1.0 - z**2)
    return np.stack([rho * np.cos(turn), rho * np.sin(turn), z], axis=1)

"""Collision and support counts of a parallel gripper at a grasp: points in its fingers, points between its pads."""

from __future__ import annotations

from typing import Protocol

import numpy as np

_CHUNK_POSES = 256  # keeps a batch of poses × points inside the cache


class GripperModel(Protocol):
    """Parallel gripper in the grasp frame: z approach, y closing, origin midway between the fingertips."""

    @property
    def clearance_m(self) -> float:
        """Distance of each open finger from its contact [m]."""
        ...

    @property
    def finger_length_m(self) -> float:
        """From the palm to the fingertips [m]."""
        ...

    @property
    def finger_thickness_m(self) -> float:
        """Of one finger, along y [m]."""
        ...

    @property
    def finger_width_m(self) -> float:
        """Of one finger, along x [m]."""
        ...


def count_points(
    T: np.ndarray, widths_m: np.ndarray, cloud: np.ndarray, gripper: GripperModel
) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of points (H,) that fingers and palm of each grasp hit, and (H,) between its pads.

    Args:
        T: (H, 4, 4) grasps.
        widths_m: (H,) distance between the contacts; the fingers are `gripper.clearance_m` outside [m].
        cloud: (M, 3) the object's points in the grasps' frame of reference [m].
        gripper: sizes of fingers and palm.
    """
    hits, held = np.zeros((2, len(T)), dtype=np.int64)
    half_pad = gripper.finger_width_m / 2.0
    for start in range(0, len(T), _CHUNK_POSES):
        part = slice(start, start + _CHUNK_POSES)
        poses = T[part]
        x, y, z = (
            (axis @ cloud.T - np.sum(axis * poses[:, :3, 3], axis=1, keepdims=True)).astype(np.float32)
            for axis in np.ascontiguousarray(poses[:, :3, :3].transpose(2, 0, 1))  # strided rows never reach BLAS
        )
        inner = (widths_m[part] / 2.0 + gripper.clearance_m)[:, None]
        y = np.abs(y)
        in_swath = (np.abs(x) < half_pad) & (z < 0.0) & (y < inner + gripper.finger_thickness_m)
        above_palm = z < -gripper.finger_length_m
        hits[part] = np.count_nonzero(in_swath & ((y > inner) | above_palm), axis=1)
        held[part] = np.count_nonzero(in_swath & (y <= inner) & ~above_palm, axis=1)
    return hits, held


def choose_candidates(scores: np.ndarray, hits: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return `n` indices, best score first: a random draw of the candidates without hits, then in order of hits."""
    order = np.argsort(hits + rng.random(len(hits)), kind="stable")[:n]
    return order[np.argsort(-scores[order], kind="stable")]

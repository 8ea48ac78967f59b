"""Grasps on a fully known object: pairs of opposed contacts, approached from all directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.base.transforms import transform_points
from models.types import GraspSet
from sim_twin.benchmark.oracle.surface import Surface


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Density of the grasps swept over an object."""

    n_points: int = 400
    """Places on the surface where a pad may press."""
    n_directions: int = 3
    """Closing directions from each place: the normal, and others inside the friction cone."""
    cone_rad: float = 0.40
    """Greatest angle between the closing direction and a contact's normal [rad]."""
    max_width_m: float = 0.080
    """Maximum width of a pair [m]; the gripper checks its own maximum later."""
    n_approaches: int = 12
    """Approaches around each pair, all the way round."""
    max_rise: float = 0.35
    """Greatest sine of the angle by which an approach may come from below."""
    depths_m: tuple[float, ...] = (0.0,)
    """Distances of the grasp's origin beyond the pair [m]."""
    cell_m: float = 0.015
    """Edge of a cell of middles [m]: of pairs in one cell, with closing directions in one cell, the best is kept."""
    cell_sine: float = 0.4
    """Edge of a cell of closing directions."""
    seed: int = 0


def sweep_grasps(surface: Surface, T_base_object: np.ndarray, contact_depth_m: float, config: SweepConfig) -> GraspSet:
    """Return grasps all over the object, in the base frame; the scores are the squareness of their contacts.

    Args:
        surface: of the object, in its own frame.
        T_base_object: (4, 4).
        contact_depth_m: distance of a grasp's origin beyond its contacts [m].
        config: how many.
    """
    middles, closings, widths, squareness = _pairs(surface, config)
    middles, closings = transform_points(T_base_object, middles), closings @ T_base_object[:3, :3].T
    pair, approaches = _approaches(closings, config)
    pair, approaches = np.tile(pair, len(config.depths_m)), np.tile(approaches, (len(config.depths_m), 1))
    beyond = np.repeat(config.depths_m, len(pair) // len(config.depths_m))
    T = np.tile(np.eye(4), (len(pair), 1, 1))
    y = closings[pair]
    T[:, :3, :3] = np.stack([np.cross(y, approaches), y, approaches], axis=2)
    T[:, :3, 3] = middles[pair] + (contact_depth_m + beyond)[:, None] * approaches
    return GraspSet(T_camera_grasps=T, scores=squareness[pair], widths_m=widths[pair], source="oracle")


def _pairs(surface: Surface, config: SweepConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return middles (K, 3), closing directions (K, 3), widths (K,) [m] and squareness (K,) in [0, 1]."""
    rng = np.random.default_rng(config.seed)
    contacts = surface.sample(0.002, config.seed)
    chosen = rng.permutation(len(contacts.points))[: config.n_points]
    points = np.repeat(contacts.points[chosen], config.n_directions, axis=0)
    normals = np.repeat(contacts.normals[chosen], config.n_directions, axis=0)
    tangents = rng.normal(size=points.shape) * np.tan(config.cone_rad) / 1.5
    # The first direction of each place is the normal itself
    tangents[:: config.n_directions] = 0.0
    directions = _unit(tangents - normals)
    here = -np.sum(directions * normals, axis=1)
    ends = surface.trace_chords(points, directions)
    found = []
    for end in ends:
        there = np.sum(directions * end.normals, axis=1)
        widths = np.linalg.norm(end.points - points, axis=1)
        good = (np.minimum(here, there) > np.cos(config.cone_rad)) & (widths > 1e-3) & (widths < config.max_width_m)
        angle = np.arccos(np.clip(np.minimum(here, there), -1.0, 1.0))
        found.append((0.5 * (points + end.points), directions, widths, 1.0 - angle / config.cone_rad, good))
    middles, directions, widths, square, good = (np.concatenate(parts) for parts in zip(*found, strict=True))
    middles, directions, widths, square = middles[good], directions[good], widths[good], square[good]
    kept = _deduplicate(middles, directions, square, config)
    return middles[kept], directions[kept], widths[kept], square[kept]


def _deduplicate(middles: np.ndarray, directions: np.ndarray, scores: np.ndarray, config: SweepConfig) -> np.ndarray:
    """Return the indices of the best of each cell of middles (K, 3) and directions (K, 3), whose sign is arbitrary."""
    # An oblique axis: with one along an edge, the sign of directions at right angles to it would be arbitrary
    upwards = directions * np.where(directions @ [0.31, 0.47, 0.83] < 0.0, -1.0, 1.0)[:, None]
    cells = np.column_stack([np.floor(middles / config.cell_m), np.round(upwards / config.cell_sine)]).astype(int)
    best_first = np.argsort(-scores, kind="stable")
    _, first = np.unique(cells[best_first], axis=0, return_index=True)
    return best_first[np.sort(first)]


def _approaches(closings: np.ndarray, config: SweepConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return which pair (M,) each of the approaches (M, 3) belongs to; one of them is as frontal as possible."""
    front = np.array([1.0, 0.0, 0.0]) - closings[:, :1] * closings
    above = np.array([0.0, 0.0, -1.0]) + closings[:, 2:] * closings
    # Jaws that close nearly along x have no frontal approach: theirs starts from above
    start = _unit(np.where(np.linalg.norm(front, axis=1, keepdims=True) > 0.2, front, above))
    other = np.cross(closings, start)
    turn = np.arange(config.n_approaches) * 2.0 * np.pi / config.n_approaches
    approaches = np.cos(turn)[:, None] * start[:, None] + np.sin(turn)[:, None] * other[:, None]  # (K, A, 3)
    pair = np.repeat(np.arange(len(closings)), config.n_approaches)
    approaches = approaches.reshape(-1, 3)
    possible = approaches[:, 2] < config.max_rise
    return pair[possible], approaches[possible]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)

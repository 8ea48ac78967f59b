"""Antipodal grasps from the visible front of an object, for any parallel gripper and from any side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from hal.base.errors import InvalidValueError
from models.samplers.gripper_models import choose_candidates, count_points
from models.samplers.surfels import Surfels, estimate_normals, estimate_occluded_sides, find_outline, smooth_normals
from models.types import GraspSet, check_request


@dataclass(frozen=True, slots=True, kw_only=True)
class AntipodalConfig:
    """Generic parallel gripper, and the density of the search."""

    max_width_m: float = 0.085
    """Widest opening [m]."""
    min_width_m: float = 0.004
    """Narrowest object to close on [m]."""
    clearance_m: float = 0.005
    """Distance of each open finger from its contact [m]."""
    finger_length_m: float = 0.05
    """From the palm to the fingertips [m]."""
    finger_thickness_m: float = 0.012
    """Of one finger, along the opening [m]."""
    finger_width_m: float = 0.02
    """Of one finger, across the opening [m]."""
    min_depth_m: float = 0.004
    """Minimum reach of the fingertips past the contacts [m]."""
    max_depth_m: float = 0.02
    """Maximum reach of the fingertips past the contacts [m]."""
    edge_setback_m: float = 0.008
    """Distance behind a visible edge at which the pads touch an occluded side [m]."""
    cone_rad: float = 0.26
    """Maximum angle between the closing line and a contact's normal [rad]; inside a friction cone of μ = 0.5."""
    n_surfels: int = 700
    """Visible points tried as contacts."""
    n_occluded: int = 300
    """Outline points tried as contacts."""
    n_collision_points: int = 700
    """Points of the cloud against which candidates are tested."""
    oversampling: float = 2.5
    """Candidates tested for each grasp returned."""

    def __post_init__(self) -> None:
        if not 0.0 < self.min_width_m < self.max_width_m:
            raise InvalidValueError(
                f"antipodal: needs 0 < min_width_m < max_width_m; got {self.min_width_m}, {self.max_width_m}.",
                code="gripper_width",
            )
        if not 0.0 <= self.min_depth_m <= self.max_depth_m < self.finger_length_m:
            raise InvalidValueError(
                f"antipodal: needs 0 ≤ min_depth_m ≤ max_depth_m < finger_length_m; got {self.min_depth_m}, "
                f"{self.max_depth_m}, {self.finger_length_m}.",
                code="gripper_depth",
            )
        if not 0.0 < self.cone_rad < np.pi / 2 or self.oversampling < 1.0:
            raise InvalidValueError(
                f"antipodal: needs 0 < cone_rad < π/2, oversampling ≥ 1; got {self.cone_rad}, {self.oversampling}.",
                code="sampling",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Candidates:
    """Grasp hypotheses: a closing line, an approach about it, and the quality of the contacts."""

    centers: np.ndarray  # (H, 3) middle between the contacts
    closing: np.ndarray  # (H, 3) unit, from one contact to the other
    approach: np.ndarray  # (H, 3) unit, square to closing
    widths: np.ndarray  # (H,)
    depths: np.ndarray  # (H,) fingertips past the contacts
    antipodality: np.ndarray  # (H,) in [0, 1]


class AntipodalSampler:
    """A `GraspGenerator` without learning: pairs contacts whose normals face each other along the line between them.

    One camera sees no two opposite sides of an object, so the far contacts are estimated from its outline
    (see `models/samplers/surfels.py`). Approaches are spread evenly about each closing line; candidates whose fingers
    or palm would hit visible points come last. Arm, table and gravity are not considered.
    """

    def __init__(self, config: AntipodalConfig | None = None) -> None:
        self.config = config or AntipodalConfig()

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps for `points` (M, 3) [m] seen from their origin, best score first.

        Raises:
            InvalidValueError: fewer than 30 points, points not finite or all on one line, or no two of them can be
                touched from opposite sides within the opening.
        """
        points = check_request(points, n)
        rng = np.random.default_rng(seed)
        surfels = self._find_surfels(points, rng)
        candidates = self._draw_candidates(surfels, points, int(np.ceil(n * self.config.oversampling)), rng)
        cloud = points[rng.permutation(len(points))[: self.config.n_collision_points]]
        T = _make_poses(candidates)
        hits, held = count_points(T, candidates.widths, cloud, self.config)
        scores = self._score(candidates, hits, held, points)
        chosen = choose_candidates(scores, hits, n, rng)
        return GraspSet(
            T_camera_grasps=T[chosen], scores=scores[chosen], widths_m=candidates.widths[chosen], source="antipodal"
        )

    def _find_surfels(self, points: np.ndarray, rng: np.random.Generator) -> Surfels:
        """Return contacts on the visible surface and on the sides behind its outline."""
        config = self.config
        tree = KDTree(points)
        visible = points[rng.permutation(len(points))[: config.n_surfels]]
        rim, outward = find_outline(points)
        keep = rng.permutation(len(rim))[: config.n_occluded]
        occluded = estimate_occluded_sides(points, tree, rim[keep], outward[keep], config.edge_setback_m)
        return Surfels(
            points=np.concatenate([visible, occluded.points]),
            normals=np.concatenate(
                [
                    smooth_normals(visible, estimate_normals(tree, visible)),
                    smooth_normals(occluded.points, occluded.normals),
                ]
            ),
        )

    def _draw_candidates(
        self, surfels: Surfels, points: np.ndarray, count: int, rng: np.random.Generator
    ) -> _Candidates:
        """Draw `count` closing lines, even over the contacts, and an approach about each."""
        config = self.config
        first, second = _find_antipodal_pairs(surfels, config)
        if len(first) == 0:
            raise InvalidValueError(
                f"No two of the {len(points)} points can be touched from opposite sides within "
                f"{config.max_width_m} m; give a cloud of one object, narrower than that on some side.",
                code="no_grasps",
            )
        picks = _draw_evenly(first, count, rng)
        first, second = first[picks], second[picks]
        closing, widths, antipodality = _align_closing(surfels, first, second)
        centers = (surfels.points[first] + surfels.points[second]) / 2.0
        return _Candidates(
            centers=centers,
            closing=closing,
            approach=_draw_approaches(closing, centers, rng),
            widths=widths,
            depths=rng.uniform(config.min_depth_m, config.max_depth_m, count),
            antipodality=antipodality,
        )

    def _score(self, candidates: _Candidates, hits: np.ndarray, held: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return scores (H,) in [0, 1] from contact angles, distance to the centroid, points between the pads, hits."""
        middle = points.mean(axis=0)
        spread = np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))
        offset = np.linalg.norm(candidates.centers - middle, axis=1) / spread
        support = held / (held + 0.02 * min(len(points), self.config.n_collision_points))
        quality = 0.45 * candidates.antipodality + 0.25 * np.exp(-0.5 * offset**2) + 0.3 * support
        return quality / (1.0 + hits)


def _make_poses(candidates: _Candidates) -> np.ndarray:
    """Return the poses (H, 4, 4) of the candidates."""
    closing, approach = candidates.closing, candidates.approach
    T = np.tile(np.eye(4), (len(candidates.widths), 1, 1))
    T[:, :3, :3] = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    T[:, :3, 3] = candidates.centers + candidates.depths[:, None] * approach
    return T


def _find_antipodal_pairs(surfels: Surfels, config: AntipodalConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (P,), (P,) of contact pairs within both friction cones and the opening."""
    points, normals = surfels.points, surfels.normals
    # |p_j − p_i|² and the two n·(p_j − p_i) of all pairs come from three matrix products.
    squared = np.sum(points**2, axis=1)
    # Rounding leaves the diagonal just below 0, which has no root
    distance = np.sqrt(np.maximum(squared[:, None] + squared - 2.0 * points @ points.T, 1e-12))
    own = np.sum(normals * points, axis=1)
    along = (normals @ points.T - own[:, None]) / distance  # cos between n_i and the line from i to j
    cosine = np.cos(config.cone_rad)
    faces_line = along < -cosine
    fits = (distance > config.min_width_m) & (distance < config.max_width_m)
    first, second = np.nonzero(faces_line & faces_line.T & fits)
    return first, second


def _align_closing(
    surfels: Surfels, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return closing directions (H, 3), widths (H,) and antipodality (H,) in [0, 1] of contact pairs.

    The jaws close along the mean of the two normals, not along the line between two noisy points: on parallel faces
    that puts the pads flat. Antipodality falls with the angle of the normals to each other and to that line.
    """
    lines = surfels.points[second] - surfels.points[first]
    facing = surfels.normals[second] - surfels.normals[first]  # of length 2 where the normals are opposite
    length = np.linalg.norm(facing, axis=1)
    closing = facing / length[:, None]
    widths = np.sum(lines * closing, axis=1)
    slant = widths / np.linalg.norm(lines, axis=1)
    return closing, widths, np.clip(1.0 - 10.0 * (1.0 - slant * length / 2.0), 0.0, 1.0)


def _draw_evenly(first: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw `count` pairs so that each first contact is equally likely, however many partners it has."""
    contacts, starts, sizes = np.unique(first, return_index=True, return_counts=True)
    drawn = rng.integers(0, len(contacts), count)
    return starts[drawn] + (rng.random(count) * sizes[drawn]).astype(np.intp)


def _draw_approaches(closing: np.ndarray, centers: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return approaches (H, 3) square to `closing`, at angles evenly spread from the view ray's own."""
    rays = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    straight = rays - np.sum(rays * closing, axis=1, keepdims=True) * closing
    straight /= np.maximum(np.linalg.norm(straight, axis=1, keepdims=True), 1e-9)
    across = np.cross(closing, straight)
    angles = rng.uniform(-np.pi, np.pi, len(closing))[:, None]
    return np.cos(angles) * straight + np.sin(angles) * across

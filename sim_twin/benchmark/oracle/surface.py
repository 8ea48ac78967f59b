"""An object's true surface: points with normals on all its sides, and the chords through it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from sim_twin.model.parts import GraspObject

_NUDGE_M = 2e-4
"""A point this far outside its own part is inside another only where the two parts meet."""
_SAME_M = 1e-6


class Contacts(NamedTuple):
    """N possible contacts of a pad, in the object's frame."""

    points: np.ndarray
    """(N, 3) [m]."""
    normals: np.ndarray
    """(N, 3) unit vectors, outwards."""


@dataclass(frozen=True, slots=True, eq=False)
class _Hull:
    """A convex part: all p with `normals @ p <= offsets`."""

    normals: np.ndarray  # (F, 3)
    offsets: np.ndarray  # (F,) [m]
    triangles: np.ndarray  # (T, 3, 3) [m]
    facing: np.ndarray  # (T, 3) the triangles' outward normals
    areas: np.ndarray  # (T,) [m²]

    @classmethod
    def from_corners(cls, corners: np.ndarray) -> _Hull:
        hull = ConvexHull(corners)
        # Qhull's facets are triangles: coplanar ones have the same equation up to rounding
        facets = np.unique(np.round(hull.equations, 9), axis=0)
        triangles = hull.points[hull.simplices]
        edges = triangles[:, 1:] - triangles[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        return cls(facets[:, :3], -facets[:, 3], triangles, hull.equations[:, :3], areas)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return (N,) whether each of `points` (N, 3) is inside."""
        return np.all(points @ self.normals.T <= self.offsets, axis=1)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where rays (N, 3) enter and leave (N,) [m], and the facets (N,) they leave by; a miss leaves before
        it enters."""
        rate = directions @ self.normals.T
        room = self.offsets - origins @ self.normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = room / rate
        # A ray parallel to a facet never crosses it
        along = np.abs(rate) < 1e-12
        enters = np.where(along, np.where(room < 0.0, np.inf, -np.inf), np.where(rate < 0.0, at, -np.inf)).max(axis=1)
        leaving = np.where(~along & (rate > 0.0), at, np.inf)
        return enters, leaving.min(axis=1), leaving.argmin(axis=1)


class Surface:
    """Outer surface of an object made of convex parts.

    Args:
        thing: the object.
    """

    def __init__(self, grasp_object: GraspObject) -> None:
        self._hulls = [_Hull.from_corners(part.corners()) for part in grasp_object.parts]

    def sample(self, spacing_m: float, seed: int = 0) -> Contacts:
        """Return points spread at random over the whole outside, one for each `spacing_m` × `spacing_m` [m]."""
        rng = np.random.default_rng(seed)
        points, normals = [], []
        for own, hull in enumerate(self._hulls):
            count = int(np.ceil(hull.areas.sum() / spacing_m**2))
            which = rng.choice(len(hull.areas), count, p=hull.areas / hull.areas.sum())
            # The square root spreads points evenly over a triangle (Osada et al. 2002)
            u, v = np.sqrt(rng.random(count)), rng.random(count)
            weights = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
            p = np.einsum("nk,nkd->nd", weights, hull.triangles[which])
            outside = p + _NUDGE_M * hull.facing[which]
            exposed = np.ones(count, dtype=bool)
            for other in self._hulls[:own] + self._hulls[own + 1 :]:
                exposed &= ~other.contains(outside)
            points.append(p[exposed])
            normals.append(hull.facing[which][exposed])
        return Contacts(np.concatenate(points), np.concatenate(normals))

    def trace_chords(self, origins: np.ndarray, directions: np.ndarray) -> tuple[Contacts, Contacts]:
        """Return where rays that start on the surface and go inwards come out: of the first wall, and of the last.

        Args:
            origins: (N, 3) [m].
            directions: (N, 3) unit vectors.
        """
        intersections = [hull.intersect(origins, directions) for hull in self._hulls]
        enters, leaves = (np.stack([intersect[k] for intersect in intersections], axis=1) for k in range(2))
        normals = np.stack(
            [h.normals[intersect[2]] for h, intersect in zip(self._hulls, intersections, strict=True)], axis=1
        )  # (N, P, 3)
        met = leaves > np.maximum(enters, 0.0) + _SAME_M
        rows = np.arange(len(origins))
        last = np.where(met, leaves, -np.inf).argmax(axis=1)
        first, reach = np.full(len(origins), -1), np.zeros(len(origins))
        order = np.where(met, enters, np.inf).argsort(axis=1)
        for part in order.T:  # walls that touch are one
            goes_on = met[rows, part] & (enters[rows, part] <= reach + _NUDGE_M) & (leaves[rows, part] > reach)
            reach = np.where(goes_on, leaves[rows, part], reach)
            first = np.where(goes_on, part, first)
        first = np.where(first < 0, last, first)
        return tuple(  # pyright: ignore[reportReturnType]
            Contacts(origins + leaves[rows, k][:, None] * directions, normals[rows, k]) for k in (first, last)
        )

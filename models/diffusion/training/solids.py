"""Solids as unions of analytic parts with exact outside distances, compiled for one core."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from hal.base.errors import InvalidValueError

BOX, CAPSULE, TORUS, LATHE = range(4)
_ROW = 18  # kind, rounding, three sizes, profile length, nine of R, three of the origin
_MAX_PROFILE = 24
_HIT_M = 2e-4  # nearer than this a ray has touched; the thinnest part, a cup's wall, has 2 mm
_GRADIENT_STEP_M = 4e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solid:
    """A union of parts; distances are exact outside, and negative inside."""

    family: str
    """Name of its kind, such as `bottle`."""
    parts: np.ndarray
    """(P, 18) one row for each part."""
    profiles: np.ndarray
    """(P, 24, 2) radius and height of the turned parts' outlines [m]."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (N,) [m] of `points` (N, 3) in the solid's frame."""
        return _distances(self.parts, self.profiles, np.ascontiguousarray(points, dtype=np.float64))

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Return the outward unit normals (N, 3) at surface `points` (N, 3)."""
        return _normals(self.parts, self.profiles, np.ascontiguousarray(points, dtype=np.float64))

    def cast(self, origins: np.ndarray, directions: np.ndarray, reach_m: float) -> np.ndarray:
        """Return the lengths (N,) [m] of rays until they touch the surface from outside; inf beyond `reach_m`."""
        return _cast(
            self.parts,
            self.profiles,
            np.ascontiguousarray(origins, dtype=np.float64),
            np.ascontiguousarray(directions, dtype=np.float64),
            reach_m,
        )

    def enclosing_radius(self) -> float:
        """Return the radius of a sphere about the frame's origin that encloses the solid [m]."""
        rng = np.random.default_rng(0)
        out = rng.normal(size=(400, 3))
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        far = 0.6
        # From any direction, the distance of a far point to the surface is at least its distance minus the radius.
        return float(np.max(far - self.distance(out * far)) + 0.002)


def make_part(
    kind: int,
    sizes: tuple[float, ...] = (),
    *,
    profile: list[tuple[float, float]] | None = None,
    rounding_m: float = 0.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rotation: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return one part's row (18,) and profile (24, 2).

    Args:
        kind: BOX (three half extents), CAPSULE (radius, half length along z), TORUS (big and small radius about y),
            LATHE (the outline turned about z).
        sizes: as `kind` says [m].
        profile: closed outline of (radius, height), starting and ending on the axis unless hollow [m].
        rounding_m: radius of the edges; the part keeps its sizes.
        origin: of the part in the solid's frame [m].
        rotation: (3, 3) part to solid.
    """
    row = np.zeros(_ROW)
    row[0], row[1] = kind, rounding_m
    row[2 : 2 + len(sizes)] = sizes
    outline = np.zeros((_MAX_PROFILE, 2))
    if profile is not None:
        if len(profile) > _MAX_PROFILE:
            raise InvalidValueError(
                f"A profile has {len(profile)} corners; allowed are {_MAX_PROFILE}.", code="profile_length"
            )
        outline[: len(profile)] = profile
        row[5] = len(profile)
    row[6:15] = (np.eye(3) if rotation is None else rotation).ravel()
    row[15:18] = origin
    return row, outline


def make_solid(family: str, parts: list[tuple[np.ndarray, np.ndarray]]) -> Solid:
    """Return the union of `parts`."""
    return Solid(
        family=family,
        parts=np.ascontiguousarray([row for row, _ in parts]),
        profiles=np.ascontiguousarray([profile for _, profile in parts]),
    )


@njit(cache=True, fastmath=True)
def _outline_distance(profile, count, rho, z):
    """Return the signed distance of (rho, z) from a closed polygon; edges on the axis are inside the turned part."""
    best = 1e9
    inside = False
    j = count - 1
    for i in range(count):
        ax, az, bx, bz = profile[j, 0], profile[j, 1], profile[i, 0], profile[i, 1]
        ex, ez, px, pz = bx - ax, bz - az, rho - ax, z - az
        if (az > z) != (bz > z) and ax + ex * pz / ez > rho:
            inside = not inside
        if ax > 1e-9 or bx > 1e-9:
            t = min(1.0, max(0.0, (px * ex + pz * ez) / (ex * ex + ez * ez + 1e-18)))
            dx, dz = px - t * ex, pz - t * ez
            best = min(best, dx * dx + dz * dz)
        j = i
    return -np.sqrt(best) if inside else np.sqrt(best)


@njit(cache=True, fastmath=True)
def _box_distance(row, x, y, z):
    qx, qy, qz = abs(x) - row[2] + row[1], abs(y) - row[3] + row[1], abs(z) - row[4] + row[1]
    outside = np.sqrt(max(qx, 0.0) ** 2 + max(qy, 0.0) ** 2 + max(qz, 0.0) ** 2)
    return outside + min(max(qx, qy, qz), 0.0) - row[1]


@njit(cache=True, fastmath=True)
def distance_at(parts, profiles, px, py, pz):
    """Return the signed distance of one point from the union of `parts`."""
    best = 1e9
    for k in range(len(parts)):
        row = parts[k]
        ox, oy, oz = px - row[15], py - row[16], pz - row[17]
        x = row[6] * ox + row[9] * oy + row[12] * oz
        y = row[7] * ox + row[10] * oy + row[13] * oz
        z = row[8] * ox + row[11] * oy + row[14] * oz
        kind = int(row[0])
        if kind == 0:
            d = _box_distance(row, x, y, z)
        elif kind == 1:
            dz = z - min(row[3], max(-row[3], z))
            d = np.sqrt(x * x + y * y + dz * dz) - row[2]
        elif kind == 2:
            ring = np.sqrt(x * x + z * z) - row[2]
            d = np.sqrt(ring * ring + y * y) - row[3]
        else:
            d = _outline_distance(profiles[k], int(row[5]), np.sqrt(x * x + y * y) + 1e-9, z) - row[1]
        best = min(best, d)
    return best


@njit(cache=True, fastmath=True)
def trace(parts, profiles, ox, oy, oz, dx, dy, dz, reach):  # noqa: PLR0917 (compiled functions take no keywords)
    """Return the length of a ray until it touches the surface (sphere tracing); inf beyond `reach`."""
    t = 0.0
    for _ in range(80):
        d = distance_at(parts, profiles, ox + t * dx, oy + t * dy, oz + t * dz)
        if d < _HIT_M:
            return t
        t += d
        if t > reach:
            return np.inf
    return np.inf


@njit(cache=True, fastmath=True)
def normal_at(parts, profiles, x, y, z):
    """Return the unit gradient of the distance at one point, as three numbers."""
    e = _GRADIENT_STEP_M
    gx = distance_at(parts, profiles, x + e, y, z) - distance_at(parts, profiles, x - e, y, z)
    gy = distance_at(parts, profiles, x, y + e, z) - distance_at(parts, profiles, x, y - e, z)
    gz = distance_at(parts, profiles, x, y, z + e) - distance_at(parts, profiles, x, y, z - e)
    norm = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-12
    return gx / norm, gy / norm, gz / norm


@njit(cache=True)
def _distances(parts, profiles, points):
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = distance_at(parts, profiles, points[i, 0], points[i, 1], points[i, 2])
    return out


@njit(cache=True)
def _normals(parts, profiles, points):
    out = np.empty((len(points), 3))
    for i in range(len(points)):
        out[i, 0], out[i, 1], out[i, 2] = normal_at(parts, profiles, points[i, 0], points[i, 1], points[i, 2])
    return out


@njit(cache=True)
def _cast(parts, profiles, origins, directions, reach):
    out = np.empty(len(origins))
    for i in range(len(origins)):
        o, d = origins[i], directions[i]
        out[i] = trace(parts, profiles, o[0], o[1], o[2], d[0], d[1], d[2], reach)
    return out

"""Exact distance test of many moved vertices against a cloud: two grids, so that empty space costs one look-up.

A grid of 8 mm excludes most vertices. For the others the few 4 mm cells around the vertex hold the points as linked
lists, in blocks so that empty space needs no lists, and true distances are compared: the answer equals brute force.
"""

# ruff: noqa: PLR0917 - compiled functions take arrays one by one

from __future__ import annotations

import numpy as np
from numba import njit

from hal.base.errors import InvalidValueError

_CELL_M = 0.004
_CELLS = 8  # per block and axis
_BLOCK_M = _CELL_M * _CELLS
_PER_BLOCK = _CELLS**3  # lists of a block that holds points; empty blocks have none
_NEAR_M = 2 * _CELL_M  # measured: as fine as the cells gains little more, for eight times the memory
_NEAR = _CELLS // 2  # per block and axis
_ROUNDING_M = 1e-9  # of coordinates up to some metres, far above float64's 1e-16
MAX_THRESHOLD_M = 0.010
"""Largest threshold of an index by default [m]."""


class SceneIndex:
    """A cloud indexed for distance thresholds. Built once per frame."""

    def __init__(self, points: np.ndarray, max_threshold_m: float = MAX_THRESHOLD_M) -> None:
        """Index `points` (M, 3) [m]; later thresholds may be up to `max_threshold_m` [m].

        Raises:
            ValueError: a point is not finite.
        """
        self.points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(self.points).all():
            raise InvalidValueError(
                "SceneIndex: the cloud holds points that are not finite. Drop them before indexing.", code="not_finite"
            )
        self.max_threshold_m = max_threshold_m
        if len(self.points):
            # A block more than the threshold, so that all cells within reach of a point are inside the grid
            margin = max_threshold_m + _BLOCK_M
            self._origin = self.points.min(axis=0) - margin
            self._shape = ((self.points.max(axis=0) + margin - self._origin) / _BLOCK_M).astype(np.int64) + 1
            self._tables = _build(self.points, self._origin, self._shape, max_threshold_m + _ROUNDING_M)

    def __len__(self) -> int:
        return len(self.points)

    def collides(self, T: np.ndarray, vertices: np.ndarray, threshold_m: float) -> np.ndarray:
        """Return (N,) whether any of `vertices` (V, 3), moved by `T` (N, 4, 4), is within `threshold_m` of a point."""
        return self.first_hits(T, vertices, threshold_m)[0] >= 0

    def first_hits(self, T: np.ndarray, vertices: np.ndarray, threshold_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return per pose the first vertex (N,) that hits and a point (N,) it hits; −1 where nothing does.

        Raises:
            ValueError: `threshold_m` is above the index's maximum.
        """
        self._check_threshold(threshold_m)
        T = np.ascontiguousarray(T, dtype=np.float64)
        if not len(self.points):
            nothing = np.full(len(T), -1)
            return nothing, nothing.copy()
        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        return _query(T, vertices, threshold_m, self.points, self._origin, self._shape, *self._tables)

    def near(self, points: np.ndarray, threshold_m: float) -> np.ndarray:
        """Return (K,) whether each of `points` (K, 3) is within `threshold_m` of the cloud."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(self.points):
            return np.zeros(len(points), dtype=bool)
        self._check_threshold(threshold_m)
        return _near_points(points, threshold_m, self.points, self._origin, self._shape, *self._tables)

    def _check_threshold(self, threshold_m: float) -> None:
        if not 0.0 <= threshold_m <= self.max_threshold_m:
            raise InvalidValueError(
                f"SceneIndex: threshold {threshold_m} m is not served (allowed 0 to {self.max_threshold_m} m). "
                "Build the index with a larger max_threshold_m.",
                code="threshold",
            )


@njit(cache=True, nogil=True)
def _build(points, origin, shape, reach):
    """Return block numbers (0 = empty), where a point is within `reach`, and the points of each cell as lists."""
    block_of = np.zeros((shape[0], shape[1], shape[2]), dtype=np.int32)
    near = np.zeros((shape[0] * _NEAR, shape[1] * _NEAR, shape[2] * _NEAR), dtype=np.bool_)
    n_blocks = 0
    for m in range(points.shape[0]):
        i = int((points[m, 0] - origin[0]) / _BLOCK_M)
        j = int((points[m, 1] - origin[1]) / _BLOCK_M)
        k = int((points[m, 2] - origin[2]) / _BLOCK_M)
        if block_of[i, j, k] == 0:
            n_blocks += 1
            block_of[i, j, k] = n_blocks
    head = np.full(n_blocks * _PER_BLOCK, -1, dtype=np.int32)
    after = np.empty(points.shape[0], dtype=np.int32)
    for m in range(points.shape[0]):
        i = int((points[m, 0] - origin[0]) / _CELL_M)
        j = int((points[m, 1] - origin[1]) / _CELL_M)
        k = int((points[m, 2] - origin[2]) / _CELL_M)
        cell = _cell(block_of, i, j, k)
        if head[cell] < 0:
            _mark_around(near, i, j, k, reach)
        after[m] = head[cell]
        head[cell] = m
    return block_of, near, head, after


@njit(cache=True, nogil=True)
def _mark_around(near, i, j, k, reach):
    """Mark the space within `reach` of cell (i, j, k), whose points then need no marks of their own."""
    i_low, i_high = int((i * _CELL_M - reach) / _NEAR_M), int(((i + 1) * _CELL_M + reach) / _NEAR_M)
    j_low, j_high = int((j * _CELL_M - reach) / _NEAR_M), int(((j + 1) * _CELL_M + reach) / _NEAR_M)
    k_low, k_high = int((k * _CELL_M - reach) / _NEAR_M), int(((k + 1) * _CELL_M + reach) / _NEAR_M)
    near[i_low : i_high + 1, j_low : j_high + 1, k_low : k_high + 1] = True


@njit(cache=True, nogil=True, inline="always")
def _cell(block_of, i, j, k):
    """Return the index of the list of cell (i, j, k); −1 in an empty block."""
    block = block_of[i // _CELLS, j // _CELLS, k // _CELLS] - 1
    if block < 0:
        return -1
    return block * _PER_BLOCK + ((i % _CELLS) * _CELLS + j % _CELLS) * _CELLS + k % _CELLS


@njit(cache=True, nogil=True)
def _touches(x, y, z, threshold, points, shape, block_of, head, after, ox, oy, oz):
    """Return a point within `threshold` of (x, y, z), or −1."""
    i_low, i_high = max(int((x - threshold - ox) / _CELL_M), 0), int((x + threshold - ox) / _CELL_M)
    j_low, j_high = max(int((y - threshold - oy) / _CELL_M), 0), int((y + threshold - oy) / _CELL_M)
    k_low, k_high = max(int((z - threshold - oz) / _CELL_M), 0), int((z + threshold - oz) / _CELL_M)
    squared = threshold * threshold
    for i in range(i_low, min(i_high + 1, shape[0] * _CELLS)):
        for j in range(j_low, min(j_high + 1, shape[1] * _CELLS)):
            for k in range(k_low, min(k_high + 1, shape[2] * _CELLS)):
                cell = _cell(block_of, i, j, k)
                if cell < 0:
                    continue
                m = head[cell]
                while m >= 0:
                    dx, dy, dz = points[m, 0] - x, points[m, 1] - y, points[m, 2] - z
                    if dx * dx + dy * dy + dz * dz <= squared:
                        return m
                    m = after[m]
    return -1


@njit(cache=True, nogil=True)
def _touch_if_near(x, y, z, threshold, points, origin, shape, block_of, near, head, after):
    """Return a point within `threshold` of (x, y, z), or −1; the coarse grid excludes most queries."""
    if x < origin[0] or y < origin[1] or z < origin[2]:
        return -1
    i, j, k = int((x - origin[0]) / _NEAR_M), int((y - origin[1]) / _NEAR_M), int((z - origin[2]) / _NEAR_M)
    if i >= near.shape[0] or j >= near.shape[1] or k >= near.shape[2] or not near[i, j, k]:
        return -1
    return _touches(x, y, z, threshold, points, shape, block_of, head, after, origin[0], origin[1], origin[2])


@njit(cache=True, nogil=True)
def _near_points(queries, threshold, points, origin, shape, block_of, near, head, after):
    mask = np.empty(queries.shape[0], dtype=np.bool_)
    for n in range(queries.shape[0]):
        x, y, z = queries[n, 0], queries[n, 1], queries[n, 2]
        mask[n] = _touch_if_near(x, y, z, threshold, points, origin, shape, block_of, near, head, after) >= 0
    return mask


@njit(cache=True, nogil=True)
def _query(T, vertices, threshold, points, origin, shape, block_of, near, head, after):
    hit_vertex = np.full(T.shape[0], -1, dtype=np.int64)
    hit_point = np.full(T.shape[0], -1, dtype=np.int64)
    # In units of `near` from the index's corner, so that the loop over empty space is nine products and one look-up
    scale = 1.0 / _NEAR_M
    n_i, n_j, n_k = float(near.shape[0]), float(near.shape[1]), float(near.shape[2])
    for n in range(T.shape[0]):
        xx, xy, xz, x0 = T[n, 0, 0] * scale, T[n, 0, 1] * scale, T[n, 0, 2] * scale, (T[n, 0, 3] - origin[0]) * scale
        yx, yy, yz, y0 = T[n, 1, 0] * scale, T[n, 1, 1] * scale, T[n, 1, 2] * scale, (T[n, 1, 3] - origin[1]) * scale
        zx, zy, zz, z0 = T[n, 2, 0] * scale, T[n, 2, 1] * scale, T[n, 2, 2] * scale, (T[n, 2, 3] - origin[2]) * scale
        for v in range(vertices.shape[0]):
            a, b, c = vertices[v, 0], vertices[v, 1], vertices[v, 2]
            i = xx * a + xy * b + xz * c + x0
            j = yx * a + yy * b + yz * c + y0
            k = zx * a + zy * b + zz * c + z0
            if i < 0.0 or j < 0.0 or k < 0.0 or i >= n_i or j >= n_j or k >= n_k or not near[int(i), int(j), int(k)]:
                continue
            x = T[n, 0, 0] * a + T[n, 0, 1] * b + T[n, 0, 2] * c + T[n, 0, 3]
            y = T[n, 1, 0] * a + T[n, 1, 1] * b + T[n, 1, 2] * c + T[n, 1, 3]
            z = T[n, 2, 0] * a + T[n, 2, 1] * b + T[n, 2, 2] * c + T[n, 2, 3]
            m = _touches(x, y, z, threshold, points, shape, block_of, head, after, origin[0], origin[1], origin[2])
            if m >= 0:
                hit_vertex[n], hit_point[n] = v, m
                break
    return hit_vertex, hit_point

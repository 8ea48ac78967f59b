"""The twin's RealSense D405: an exact image, its intrinsics, and the stereo noise that it adds.

Sources: Intel's datasheet and depth-quality tables, and figures measured on real units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numba
import numpy as np

from hal.base.messages import Intrinsics
from sim_twin.model.objects import OBJECT_BODY


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One exact image."""

    colour: np.ndarray
    """(H, W, 3) uint8, RGB."""
    z_m: np.ndarray
    """(H, W) float32 distance along the optical axis [m]; 0 where nothing is hit."""
    mask: np.ndarray
    """(H, W) bool, the object's pixels."""


class WristRenderer(Protocol):
    """Draws for the wrist camera; belongs to the thread that made it."""

    def render(self, data: mujoco.MjData) -> View:
        """Draw the state `data` (kinematics computed)."""
        ...

    def close(self) -> None:
        """Free what the renderer holds."""
        ...


def camera_id(model: mujoco.MjModel) -> int:
    """Return the number of the wrist camera."""
    return model.camera("wrist").id


def object_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms (ngeom,) bool are the object's."""
    return model.geom_bodyid == model.body(OBJECT_BODY).id


INTRINSICS = Intrinsics(width=640, height=480, fx=393.0305, fy=392.6793, cx=312.918, cy=240.937)
"""The colour stream of a real unit at 640×480, taken as undistorted."""
FRAME_PERIOD_S = 1.0 / 30.0
# The D405's default in librealsense (d400-device.cpp); other D400 cameras have 1 mm
DEPTH_UNIT_M = 1e-4
# As librealsense reports it (`stereo_baseline` 18.0 mm)
BASELINE_M = 0.018
MIN_Z_M = 0.070
"""Nearer than this the stereo has no match at 640×480 (datasheet: 70 mm at 848×480; measured: fails below 70 mm)."""
MAX_Z_M = 6.5535
"""Largest distance that fits 16 bits of 0.1 mm."""
# The camera's processor computes disparities with five fractional bits (librealsense)
DISPARITY_STEP_PX = 1.0 / 32.0
DISPARITY_SD_PX = 0.08
"""Standard deviation of the matched disparity on textured surfaces (0.05 to 0.08 on real units)."""

_CORRELATION_PX = 3  # half width of the box that smooths the noise: the matcher compares 7 to 9 pixels at a time
_EDGE_RATIO = 0.02  # neighbours that differ by more than 2 % of the depth are an edge
_EDGE_LOSS = 0.45  # ratio of edge pixels without a match
_GRAZING_COS = 0.18  # surfaces at more than 80° from their normal give no match
_BLOB_SIGMA = 3.4  # smooth noise above this is a patch without texture: a hole of a few pixels
_COLOUR_SD = 1.5  # of 255


@numba.njit(nogil=True, cache=True)
def _hash(x: np.uint64) -> np.uint64:
    """SplitMix64: the same number for the same pixel and frame on every machine."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@numba.njit(nogil=True, cache=True)
def _gauss(bits: np.uint64) -> float:
    """Return a normal number from 64 random bits: the sum of four uniform 16-bit ones (true within 3.4 sigma)."""
    mask = np.uint64(0xFFFF)
    total = float(bits & mask) + float((bits >> np.uint64(16)) & mask)
    total += float((bits >> np.uint64(32)) & mask) + float(bits >> np.uint64(48))
    # Four uniform numbers have a variance of 4 / 12 in sum: √3 makes it 1
    return (total / 65536.0 - 2.0) * 1.7320508


@numba.njit(nogil=True, cache=True)
def _smooth_noise(height: int, width: int, key: np.uint64, radius: int) -> np.ndarray:
    """Return a field (H, W) of unit variance, white noise under a box of 2·radius + 1 pixels."""
    size = 2 * radius + 1
    rows, columns = height + 2 * radius, width + 2 * radius
    along = np.empty((rows, width), np.float32)
    line = np.empty(columns, np.float32)
    # A box filter is separable: first along the rows, then along the columns
    for v in range(rows):
        for u in range(columns):
            line[u] = _gauss(_hash(key + np.uint64(v * columns + u)))
        for u in range(width):
            total = np.float32(0.0)
            for k in range(size):
                total += line[u + k]
            along[v, u] = total
    field = np.empty((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            total = np.float32(0.0)
            for k in range(size):
                total += along[v + k, u]
            # The sum of size² numbers of unit variance has the standard deviation `size`
            field[v, u] = total / size
    return field


@numba.njit(nogil=True, cache=True)
def _visible_to_both(z: np.ndarray, focal_baseline: float) -> np.ndarray:
    """Return the left image's pixels (H, W) that are visible in the right one too.

    Column u of the left image is at u − f·B/z in the right one: below zero it is outside, and it is occluded by
    anything nearer, further right, that maps to the same or a lower column.
    """
    height, width = z.shape
    visible = np.zeros((height, width), np.bool_)
    for v in range(height):
        leftmost = np.inf
        for u in range(width - 1, -1, -1):
            if z[v, u] <= 0.0:
                continue
            right_u = u - focal_baseline / z[v, u]
            visible[v, u] = 0.0 <= right_u < leftmost + 0.5
            leftmost = min(leftmost, right_u)
    return visible


@numba.njit(nogil=True, cache=True)
def _is_grazing(z: np.ndarray, v: int, u: int, pinhole: tuple[float, float, float, float]) -> bool:
    """True where the surface through the four neighbours is at too flat an angle."""
    fx, fy, cx, cy = pinhole
    zc = z[v, u]
    x, y = (u - cx) / fx, (v - cy) / fy
    zu, zv = 0.5 * (z[v, u + 1] - z[v, u - 1]) * fx, 0.5 * (z[v + 1, u] - z[v - 1, u]) * fy
    # Normal of the surface z(u, v), up to its length, times the ray (x, y, 1).
    nx, ny, nz = -zu, -zv, zc + x * zu + y * zv
    dot = nx * x + ny * y + nz
    return abs(dot) < _GRAZING_COS * np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1.0))


@numba.njit(nogil=True, cache=True)
def _measure(z: np.ndarray, key: np.uint64, pinhole: tuple[float, float, float, float], min_z_m: float) -> np.ndarray:
    height, width = z.shape
    focal_baseline = pinhole[0] * BASELINE_M
    noise = _smooth_noise(height, width, key, _CORRELATION_PX)
    visible = _visible_to_both(z, focal_baseline)
    out = np.zeros((height, width), np.float32)
    # Pixels at the border lack the neighbours for the test of an edge
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            zc = z[v, u]
            if not visible[v, u] or zc < min_z_m or zc > MAX_Z_M or noise[v, u] > _BLOB_SIGMA:
                continue
            low, high = zc, zc
            for near in (z[v, u - 1], z[v, u + 1], z[v - 1, u], z[v + 1, u]):
                low, high = min(low, near), max(high, near)
            if high - low > _EDGE_RATIO * zc:
                # The upper 53 bits, as many as a float holds; the constant gives a stream apart from that of the noise
                chance = float(_hash(key ^ np.uint64(v * width + u + 0x5DEECE66D)) >> np.uint64(11)) / 2.0**53
                if chance < _EDGE_LOSS or _is_grazing(z, v, u, pinhole):
                    continue
            disparity = focal_baseline / zc + DISPARITY_SD_PX * noise[v, u]
            disparity = np.round(disparity / DISPARITY_STEP_PX) * DISPARITY_STEP_PX
            if disparity <= 0.0:
                continue
            units = np.round(focal_baseline / disparity / DEPTH_UNIT_M)
            if min_z_m / DEPTH_UNIT_M <= units <= 65535.0:
                out[v, u] = units * DEPTH_UNIT_M
    return out


@numba.njit(nogil=True, cache=True)
def _round_exact(z: np.ndarray, min_z_m: float) -> np.ndarray:
    out = np.zeros(z.shape, np.float32)
    for v in range(z.shape[0]):
        for u in range(z.shape[1]):
            if min_z_m <= z[v, u] <= MAX_Z_M:
                out[v, u] = np.round(z[v, u] / DEPTH_UNIT_M) * DEPTH_UNIT_M
    return out


@numba.njit(nogil=True, cache=True)
def _add_colour_noise(colour: np.ndarray, key: np.uint64) -> np.ndarray:
    out = np.empty_like(colour)
    height, width, _ = colour.shape
    for v in range(height):
        for u in range(width):
            bits = _hash(key + np.uint64(v * width + u))
            for channel in range(3):
                bits = _hash(bits)
                value = np.round(colour[v, u, channel] + _COLOUR_SD * _gauss(bits))
                out[v, u, channel] = min(max(value, 0.0), 255.0)
    return out


def _key(seed: int, sequence: int) -> np.uint64:
    # SeedSequence mixes its words: neighbouring seeds and frames have unrelated noise
    return np.uint64(int(np.random.SeedSequence([seed, sequence]).generate_state(1, np.uint64)[0]))


def measure_depth(
    z: np.ndarray, seed: int, sequence: int, pinhole: Intrinsics = INTRINSICS, min_z_m: float = MIN_Z_M
) -> np.ndarray:
    """Return the depth that the stereo measures (H, W) float32 [m], 0 where it finds no match.

    Args:
        z: exact distance along the optical axis (H, W) float32 [m]; 0 where nothing is hit.
        seed: of the scene; with `sequence` it fixes the noise.
        sequence: number of the frame.
        pinhole: of the image.
        min_z_m: nearest distance with a match [m].

    The disparity f·B/z gets noise of 0.08 px, correlated over 7 pixels, is quantised to 1/32 px and turned back into a
    depth in units of 0.1 mm, so that sigma_z = z²·sd/(f·B): 0.5 mm at 0.2 m, 2.9 mm at 0.5 m. No match is found nearer
    than min-Z, in the band at the left that only the left imager sees, in the shadow left of near things, at part of
    the edges, on surfaces visible at a grazing angle, and in small patches at random.
    """
    i = pinhole
    return _measure(z, _key(seed, sequence), (i.fx, i.fy, i.cx, i.cy), min_z_m)


def round_depth(z: np.ndarray, min_z_m: float = MIN_Z_M) -> np.ndarray:
    """Return exact depth (H, W) float32 [m] in units of 0.1 mm, 0 outside the range that can be expressed."""
    return _round_exact(z, min_z_m)


def measure_colour(colour: np.ndarray, seed: int, sequence: int) -> np.ndarray:
    """Return the colour image (H, W, 3) uint8 with the imager's noise."""
    return _add_colour_noise(colour, _key(seed, sequence))

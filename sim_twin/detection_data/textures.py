"""Procedural textures: surfaces of tables, floors, walls and props, from a random generator alone."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

_QUIET = 0.75
"""Ratio of quiet surfaces: few tables and fewer packages are in loud checks."""


def random_rgb(rng: np.random.Generator) -> np.ndarray:
    """Return a colour (3,) in [0, 1]: half of them bright, the others greyish, as things in a room are."""
    saturation = rng.uniform(0.35, 1.0) if rng.random() < 0.5 else rng.uniform(0.0, 0.3)
    return np.array(colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.12, 1.0)))


def random_texture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a picture (size, size, 3) uint8 of a random kind, some of them smudged."""
    kind = _KINDS[rng.integers(len(_KINDS))]
    blend = kind(rng, size)[..., None]
    low, high = random_rgb(rng), random_rgb(rng)
    if rng.random() < _QUIET:  # both colours alike
        high = np.clip(low + rng.normal(0.0, 0.08, 3), 0.0, 1.0)
    picture = low + (high - low) * blend
    if rng.random() < 0.5:
        picture = picture * (1.0 - rng.uniform(0.05, 0.35) * _clouds(rng, size)[..., None])
    return (np.clip(picture, 0.0, 1.0) * 255).astype(np.uint8)


def _grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    return u, v


def _rotated_grid(rng: np.random.Generator, size: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = _grid(size)
    angle = rng.uniform(0.0, np.pi)
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    return c * u + s * v, c * v - s * u


def _plain(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.zeros((size, size), np.float32)


def _clouds(rng: np.random.Generator, size: int) -> np.ndarray:
    """Noise of several octaves in [0, 1]."""
    total = np.zeros((size, size), np.float32)
    weight = 1.0
    for cells in (2, 4, 8, 16, 32, 64)[rng.integers(0, 3) :]:
        coarse = rng.random((cells, cells), dtype=np.float32)
        total += weight * cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
        weight *= rng.uniform(0.4, 0.8)
    total -= total.min()
    return total / max(float(total.max()), 1e-6)


def _gradient(rng: np.random.Generator, size: int) -> np.ndarray:
    u, _ = _rotated_grid(rng, size)
    return (u - u.min()) / (u.max() - u.min())


def _checker(rng: np.random.Generator, size: int) -> np.ndarray:
    u, v = _rotated_grid(rng, size)
    cells = rng.integers(2, 14)
    return ((np.floor(u * cells) + np.floor(v * cells)) % 2).astype(np.float32)


def _stripes(rng: np.random.Generator, size: int) -> np.ndarray:
    u, _ = _rotated_grid(rng, size)
    wave = np.sin(2 * np.pi * u * rng.uniform(2, 24))
    return (wave > rng.uniform(-0.7, 0.7)).astype(np.float32) if rng.random() < 0.6 else 0.5 + 0.5 * wave


def _wood(rng: np.random.Generator, size: int) -> np.ndarray:
    u, v = _grid(size)
    bend = rng.uniform(0.02, 0.15) * (_clouds(rng, size) - 0.5)
    rings = np.sin(2 * np.pi * rng.uniform(4, 16) * (u + bend + 0.03 * np.sin(2 * np.pi * v * rng.integers(1, 4))))
    fibre = cv2.resize(rng.random((4, size), dtype=np.float32), (size, size), interpolation=cv2.INTER_LINEAR)
    return 0.35 * (rings + 1.0) + 0.3 * fibre


def _speckle(rng: np.random.Generator, size: int) -> np.ndarray:
    field = cv2.GaussianBlur(rng.standard_normal((size, size), dtype=np.float32), (0, 0), rng.uniform(0.6, 4.0))
    # A sixteenth of the pixels is enough for a quantile
    return (field > np.quantile(field[::4, ::4], rng.uniform(0.5, 0.95))).astype(np.float32)


def _print(rng: np.random.Generator, size: int) -> np.ndarray:
    """Rectangles, discs and lines of writing, as on a package or a poster."""
    picture = np.zeros((size, size), np.float32)
    for _ in range(rng.integers(2, 10)):
        x, y = (int(a) for a in rng.integers(0, size, 2))
        w, h = (int(a) for a in rng.integers(size // 20, size // 2, 2))
        shade = float(rng.random())
        if rng.random() < 0.6:
            cv2.rectangle(picture, (x, y), (x + w, y + h), shade, -1)
        else:
            cv2.ellipse(picture, (x, y), (w // 2, h // 2), float(rng.uniform(0, 180)), 0, 360, shade, -1)
    for row in range(rng.integers(0, 8)):
        y = int(size * (0.3 + 0.07 * row))
        for x in range(size // 8, size - size // 6, size // 12):
            if rng.random() < 0.8:
                cv2.line(picture, (x, y), (x + int(rng.integers(2, max(size // 14, 3))), y), 1.0, max(size // 100, 1))
    return picture


_KINDS = (_plain, _plain, _clouds, _gradient, _checker, _stripes, _wood, _wood, _speckle, _print)

"""Photometric augmentation of an image: exposure, white balance, blur, noise, vignetting and JPEG."""

from __future__ import annotations

import cv2
import numpy as np

_DARK = 45.0


def augment_image(colour: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return `colour` (H, W, 3) uint8 RGB with random flaws of a cheap camera in a badly lit room.

    A third of the pictures, if not too dark, only get the little noise of a good exposure. Geometry stays: masks
    remain exact.
    """
    # Every eighth pixel is enough for a mean
    if rng.random() < 0.33 and colour[::8, ::8].mean() > _DARK:
        return _with_noise(colour.astype(np.float32), rng.uniform(0.0, 2.5), rng)
    picture = _expose(colour, rng)
    if rng.random() < 0.25:
        picture = _vignette(picture, rng.uniform(0.1, 0.5))
    if rng.random() < 0.35:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.4, 1.6))
    if rng.random() < 0.20:
        picture = _motion_blur(picture, rng)
    noisy = _with_noise(picture, rng.uniform(0.5, 6.0), rng)
    if rng.random() < 0.4:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 90))]
        decoded = cv2.imdecode(cv2.imencode(".jpg", noisy, quality)[1], cv2.IMREAD_COLOR)
        assert decoded is not None
        return np.asarray(decoded)
    return noisy


def _expose(colour: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Gain, gamma, white balance and black level, through one table for each channel.

    The gain aims at a mean of 60 to 165, as automatic exposure does, and reaches it by a factor of 0.6 to 8.
    """
    level = np.arange(256, dtype=np.float64) / 255
    balance = rng.uniform(0.82, 1.18, 3) if rng.random() < 0.6 else np.ones(3)
    gain = np.clip(rng.uniform(60, 165) / max(float(colour[::8, ::8].mean()), 1.0), 0.6, 8.0)
    table = level[:, None] ** rng.uniform(0.7, 1.3) * balance * gain
    table = np.clip(table + rng.uniform(-0.04, 0.08), 0.0, 1.0) * 255
    return cv2.LUT(colour, table[None].astype(np.float32))


def _vignette(picture: np.ndarray, depth: float) -> np.ndarray:
    height, width = picture.shape[:2]
    v, u = np.linspace(-1, 1, height, dtype=np.float32), np.linspace(-1, 1, width, dtype=np.float32)
    return picture * (1.0 - np.float32(depth / 2) * (u[None, :] ** 2 + v[:, None] ** 2))[..., None]


def _motion_blur(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    length = int(rng.integers(3, 10))
    kernel = np.zeros((length, length), np.float32)
    angle, middle = rng.uniform(0, np.pi), (length - 1) / 2
    along = middle * np.array([np.cos(angle), np.sin(angle)])
    # The kernel is a line through its middle, so that masks stay in place
    ends = [tuple(round(a) for a in middle + side * along) for side in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return cv2.filter2D(picture, -1, kernel / kernel.sum())


def _with_noise(picture: np.ndarray, sd: float, rng: np.random.Generator) -> np.ndarray:
    noise = rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(picture + np.float32(sd) * noise, 0, 255).astype(np.uint8)

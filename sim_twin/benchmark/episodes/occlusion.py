"""Hides a share of the object from the camera, as a card held close before the lens does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame

_CARD_RGB = (38, 40, 44)
_MARGIN_PX = 12


def occlude(frame: RgbdFrame, share: float, seed: int) -> RgbdFrame:
    """Return `frame` with `share` of the object's pixels behind a card that comes in from a random side.

    The card is nearer than the camera's least distance, so it has a colour and no depth. It covers the object's
    bounding box, a little more, and nothing else: what is judged is the half-seen object, not a half-seen table.

    Raises:
        ValueError: the frame does not say where the object is.
    """
    if share == 0.0:
        return frame
    if frame.ground_truth_mask is None:
        raise InvalidValueError("only the twin's frames say where the object is; nothing else can be occluded.")
    if not frame.ground_truth_mask.any():
        return frame
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    v, u = np.indices(frame.ground_truth_mask.shape)
    along = np.cos(angle) * u + np.sin(angle) * v
    rows, columns = np.nonzero(frame.ground_truth_mask)
    edge = np.quantile(along[rows, columns], 1.0 - share)
    card = along > edge
    card &= (u >= columns.min() - _MARGIN_PX) & (u <= columns.max() + _MARGIN_PX)
    card &= (v >= rows.min() - _MARGIN_PX) & (v <= rows.max() + _MARGIN_PX)
    colour, depth = frame.colour.copy(), frame.depth_m.copy()
    colour[card], depth[card] = _CARD_RGB, 0.0
    return replace(frame, colour=colour, depth_m=depth, ground_truth_mask=frame.ground_truth_mask & ~card)

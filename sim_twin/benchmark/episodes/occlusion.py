"""Occlusion of a ratio of the object, as by a card held close to the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hal.base.errors import InvalidValueError
from hal.base.messages import RgbdFrame

_CARD_RGB = (38, 40, 44)
_MARGIN_PX = 12


def occlude(frame: RgbdFrame, ratio: float, seed: int) -> RgbdFrame:
    """Return `frame` with `ratio` of the object's pixels behind a card that enters from a random side.

    The card is nearer than the camera's minimum distance, so it has a colour and no depth. It covers the object's
    bounding box, a little more, and nothing else: the object is occluded, not the table.

    Raises:
        InvalidValueError: the frame has no ground truth of the object.
    """
    if ratio == 0.0:
        return frame
    if frame.ground_truth_mask is None:
        raise InvalidValueError(
            "occlusion: the frame has no ground-truth mask. Use frames of the twin.", code="no_ground_truth"
        )
    if not frame.ground_truth_mask.any():
        return frame
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    v, u = np.indices(frame.ground_truth_mask.shape)
    along = np.cos(angle) * u + np.sin(angle) * v
    rows, columns = np.nonzero(frame.ground_truth_mask)
    edge = np.quantile(along[rows, columns], 1.0 - ratio)
    card = along > edge
    card &= (u >= columns.min() - _MARGIN_PX) & (u <= columns.max() + _MARGIN_PX)
    card &= (v >= rows.min() - _MARGIN_PX) & (v <= rows.max() + _MARGIN_PX)
    colour, depth = frame.colour.copy(), frame.depth_m.copy()
    colour[card], depth[card] = _CARD_RGB, 0.0
    return replace(frame, colour=colour, depth_m=depth, ground_truth_mask=frame.ground_truth_mask & ~card)

"""Procedural objects: families for the training, and held-out families for the evaluation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from hal.base.errors import InvalidValueError
from models.diffusion.training.solids import BOX, CAPSULE, LATHE, TORUS, Solid, make_part, make_solid

PartArrays = tuple[np.ndarray, np.ndarray]
Draw = Callable[[float, float], float]


def make_shape(family: str, rng: np.random.Generator) -> Solid:
    """Return a random object of `family`, its up along z and its middle near the origin [m].

    Raises:
        InvalidValueError: the family is unknown.
    """
    makers = {**KNOWN_FAMILIES, **HELD_OUT_FAMILIES}
    if family not in makers:
        raise InvalidValueError(f"Unknown family {family!r}; known: {', '.join(makers)}.", code="unknown_family")
    return make_solid(family, makers[family](lambda low, high: float(rng.uniform(low, high)), rng))


def _turn_outline(points: list[tuple[float, float]], rounding_m: float = 0.0, middle: bool = True) -> PartArrays:
    """Return an outline turned about z, closed along the axis, its middle at the origin."""
    low, high = points[0][1], points[-1][1]
    shift = (low + high) / 2.0 if middle else 0.0
    # The rounding grows the outline, so it is inset by as much
    inset = [
        (max(r - rounding_m, 0.001), z - shift + (rounding_m if z == low else -rounding_m if z == high else 0.0))
        for r, z in points
    ]
    return make_part(LATHE, profile=[(0.0, inset[0][1]), *inset, (0.0, inset[-1][1])], rounding_m=rounding_m)


def _hollow(radius: float, foot: float, height: float, wall: float) -> PartArrays:
    """Return a cup: an open vessel with a flat bottom."""
    half = height / 2.0
    outline = [(0.0, -half), (foot, -half), (radius, half), (radius - wall, half), (foot - wall, wall - half)]
    return make_part(LATHE, profile=[*outline, (0.0, wall - half)])


def _box(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    sizes = np.array([u(0.010, 0.055), u(0.010, 0.060), u(0.012, 0.11)])
    return [make_part(BOX, tuple(sizes), rounding_m=min(u(0.0, 0.004), 0.4 * sizes.min()))]


def _cylinder(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    radius, half = u(0.010, 0.052), u(0.012, 0.12)
    return [_turn_outline([(radius, -half), (radius, half)], u(0.0, 0.003))]


def _capsule(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    return [make_part(CAPSULE, (u(0.010, 0.038), u(0.01, 0.08)))]


def _sphere(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    return [make_part(CAPSULE, (u(0.015, 0.05), 0.0))]


def _cone(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    wide, half = u(0.02, 0.05), u(0.02, 0.09)
    return [_turn_outline([(wide, -half), (u(0.1, 0.75) * wide, half)], u(0.0, 0.002))]


def _bottle(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    radius, body = u(0.018, 0.048), u(0.05, 0.16)
    neck, shoulder, top = u(0.25, 0.6) * radius, u(0.008, 0.05), u(0.015, 0.05)
    waist = radius * u(0.8, 1.0)
    points = [
        (radius * u(0.85, 1.0), 0.0),
        (radius, 0.06 * body),
        (waist, u(0.35, 0.65) * body),
        (radius, body),
        (0.6 * radius + 0.4 * neck, body + 0.6 * shoulder),
        (neck, body + shoulder),
        (neck, body + shoulder + 0.4 * top),
        (neck * u(1.0, 1.35), body + shoulder + 0.4 * top),
    ]
    return [_turn_outline([*points, (points[-1][0], body + shoulder + top)], 0.001)]


def _cup(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    radius, height = u(0.025, 0.048), u(0.05, 0.13)
    return [_hollow(radius, radius * u(0.65, 1.0), height, u(0.002, 0.005))]


def _l_shape(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    thick, long, high = u(0.012, 0.035), u(0.03, 0.065), u(0.03, 0.07)
    foot, post = u(0.010, 0.022), u(0.010, 0.022)
    return [
        make_part(BOX, (thick, long, foot), origin=(0.0, 0.0, foot - high / 2.0)),
        make_part(BOX, (thick, post, high), origin=(0.0, post - long, high / 2.0)),
    ]


def _lathe(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    """Return a solid of revolution with a random smooth outline, like vases, skittles, jars, spools."""
    height, widest = u(0.04, 0.22), u(0.015, 0.05)
    knots = rng.uniform(0.25, 1.0, int(rng.integers(3, 7)))
    at = np.linspace(0.0, 1.0, 14)
    # A cubic spline overshoots its knots
    radii = widest * np.clip(CubicSpline(np.linspace(0.0, 1.0, len(knots)), knots)(at), 0.15, 1.1)
    return [_turn_outline([(float(r), float(z)) for r, z in zip(radii, at * height, strict=True)], 0.001)]


def _union(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    """Return two or three touching boxes, capsules and cylinders, at right angles or random orientations."""
    parts = []
    for lift in rng.permutation([-0.025, 0.03, 0.0])[: rng.integers(2, 4)]:
        kind, slim = rng.integers(3), u(0.0, 1.0) < 0.4
        low, high = (0.006, 0.014) if slim else (0.012, 0.036)
        origin = (u(-0.015, 0.015), u(-0.015, 0.015), lift)
        turn = np.eye(3)
        if u(0.0, 1.0) < 0.3:
            turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        elif u(0.0, 1.0) < 0.4:
            turn = Rotation.from_euler("xy"[rng.integers(2)], 90.0, degrees=True).as_matrix()
        if kind == 0:
            sizes = (u(low, high), u(0.010, 0.04), u(0.015, 0.06))
            parts.append(make_part(BOX, sizes, origin=origin, rotation=turn))
            continue
        radius, half = u(low, high), u(0.015, 0.07)
        if kind == 1:
            parts.append(make_part(CAPSULE, (radius, half), origin=origin, rotation=turn))
        else:
            row, profile = _turn_outline([(radius, -half), (radius, half)])
            row[6:15], row[15:18] = turn.ravel(), origin
            parts.append((row, profile))
    return parts


def _mug(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    radius, height = u(0.028, 0.045), u(0.07, 0.11)
    handle = make_part(TORUS, (height * u(0.24, 0.32), u(0.004, 0.006)), origin=(radius + 0.004, 0.0, 0.0))
    return [_hollow(radius, radius, height, u(0.003, 0.005)), handle]


def _dumbbell(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    radius, half = u(0.018, 0.034), u(0.035, 0.065)
    balls = [make_part(CAPSULE, (radius, 0.0), origin=(0.0, 0.0, z)) for z in (-half, half)]
    return [*balls, make_part(CAPSULE, (u(0.008, 0.014), half))]


def _goblet(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    foot, stem, bowl = u(0.025, 0.035), u(0.004, 0.008), u(0.025, 0.042)
    low, mid, high = 0.006, u(0.05, 0.09), u(0.11, 0.16)
    points = [(foot, 0.0), (foot, low), (stem, 2 * low), (stem, mid), (bowl, mid + 0.4 * (high - mid)), (bowl, high)]
    return [_turn_outline(points)]


def _hammer(u: Draw, rng: np.random.Generator) -> list[PartArrays]:
    half = u(0.06, 0.1)
    head = make_part(BOX, (u(0.01, 0.02), u(0.03, 0.05), u(0.01, 0.02)), origin=(0.0, 0.0, half), rounding_m=0.002)
    return [head, make_part(CAPSULE, (u(0.008, 0.014), half))]


KNOWN_FAMILIES = {
    "box": _box,
    "cylinder": _cylinder,
    "bottle": _bottle,
    "capsule": _capsule,
    "sphere": _sphere,
    "cone": _cone,
    "cup": _cup,
    "l_shape": _l_shape,
    "lathe": _lathe,
    "union": _union,
}
"""Families in the training data."""
FAMILY_WEIGHTS = {
    "box": 0.17,
    "cylinder": 0.09,
    "bottle": 0.11,
    "capsule": 0.03,
    "sphere": 0.03,
    "cone": 0.06,
    "cup": 0.10,
    "l_shape": 0.12,
    "lathe": 0.12,
    "union": 0.17,
}
"""Ratio of each known family in a data set."""
HELD_OUT_FAMILIES = {"mug": _mug, "dumbbell": _dumbbell, "goblet": _goblet, "hammer": _hammer}
"""Families in the evaluation only."""

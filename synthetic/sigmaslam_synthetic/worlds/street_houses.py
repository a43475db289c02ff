"""Houses, walls and fences; x runs along the street, which lies towards -y, and the ground is at z = 0."""

import numpy as np

from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Panel
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, Part

_BURIED = 2.5  # metres that a house reaches into the ground, for slopes
_FACING_STREET = (float(np.pi / 2), 0.0, 0.0)


def house(rng: np.random.Generator, palette: Palette, wide: float, deep: float, high: float, detail: float) -> Model:
    """A house with what stands out of its front: door, balconies, bays, pipes, awnings, signs.

    Args:
        wide, deep, high: metres.
        detail: share of these things that it has, 0 to 1.
    """
    wall = palette.choose("facade")
    parts = [Part(Box((wide, deep, high + _BURIED)), wall, (0.0, 0.0, (high - _BURIED) / 2))]
    front = -deep / 2
    parts += _roof(rng, palette, wide, deep, high)
    if rng.random() < 0.5 * detail:  # a plinth
        z = rng.uniform(0.4, 1.0)
        parts.append(
            Part(Box((wide + 0.08, deep + 0.16, z + _BURIED)), palette.choose("stone"), (0, 0, (z - _BURIED) / 2))
        )
    if rng.random() < 0.5 * detail:  # a shop with its sign
        z = rng.uniform(2.6, 3.2)
        width = wide * rng.uniform(0.5, 0.95)
        parts.append(Part(Panel(width, z - 0.5), palette.choose("poster"), (0.0, front - 0.1, z / 2), _FACING_STREET))
        parts.append(Part(Box((width, 0.16, 0.6)), palette.choose("sign"), (0.0, front - 0.08, z + 0.3)))
        if rng.random() < 0.5:
            tilt = (float(rng.uniform(0.3, 0.6)), 0.0, 0.0)
            parts.append(Part(Box((width, 1.3, 0.05)), palette.choose("stripes"), (0.0, front - 0.7, z), tilt))
    x = rng.uniform(-0.35, 0.35) * wide
    parts.append(Part(Box((rng.uniform(0.9, 1.3), 0.2, 2.1 + 0.3)), palette.choose("door"), (x, front - 0.03, 1.05)))
    parts.append(Part(Box((1.7, rng.uniform(0.6, 1.2), 0.14)), palette.choose("stone"), (x, front - 0.3, 2.4)))
    storeys = np.arange(3.2, high - 1.5, 3.0)
    if rng.random() < 0.45 * detail and len(storeys):
        for z in storeys:
            for x in _spread(rng, wide, 2):
                parts += _balcony(rng, palette, float(x), front, float(z))
    elif rng.random() < 0.6 * detail and len(storeys):  # bays
        for x in _spread(rng, wide, 1):
            size = (rng.uniform(1.6, 2.6), rng.uniform(0.6, 1.1), 0.85 * high)
            parts.append(Part(Box(size), palette.choose("facade"), (float(x), front, size[2] / 2)))
    for x in _spread(rng, wide, 1):
        pipe = Cylinder(0.06, high, None, 4)
        parts.append(Part(pipe, palette.choose("metal"), (float(x), front - 0.1, high / 2)))
    return tuple(parts)


def wall(rng: np.random.Generator, palette: Palette, long: float) -> Model:
    """A garden wall, hedge or fence of given length."""
    style = rng.random()
    high = rng.uniform(0.7, 1.9)
    if style < 0.4:
        return (
            Part(Box((long, 0.25, high + 0.6)), palette.choose("masonry"), (0.0, 0.0, high / 2 - 0.3)),
            Part(Box((long, 0.35, 0.08)), palette.choose("stone"), (0.0, 0.0, high + 0.02)),
        )
    if style < 0.7:
        leaves = palette.choose("leaves")
        lumps = [
            Part(
                Box((long / 3, rng.uniform(0.6, 0.9), high + 0.3)), leaves, (x * long, rng.uniform(-0.1, 0.1), high / 2)
            )
            for x in (-0.33, 0.0, 0.33)
        ]
        twigs = [
            Part(
                Panel(0.4, 0.3),
                palette.choose("leaves"),
                (rng.uniform(-0.5, 0.5) * long, -0.4 + rng.uniform(-0.1, 0.1), rng.uniform(0.3, 1.1) * high),
                tuple(rng.uniform(-2, 2, 3).tolist()),
            )
            for _ in range(4)
        ]
        return (*lumps, *twigs)
    if style < 0.85:
        return (Part(Box((long, 0.06, high + 0.4)), palette.choose("wood"), (0.0, 0.0, high / 2 - 0.2)),)
    rail, post = palette.choose("metal"), palette.choose("dark")
    count = int(long / 0.6)
    even = ((np.arange(count) + 0.5) / count - 0.5) * long
    return (
        *(Part(Box((long, 0.05, 0.06)), rail, (0.0, 0.0, z * high)) for z in (0.25, 0.95)),
        *(Part(Panel(0.06, high), post, (x, 0.01, high / 2), _FACING_STREET) for x in even),
    )


def _roof(rng: np.random.Generator, palette: Palette, wide: float, deep: float, high: float) -> list[Part]:
    style = rng.random() + (0.3 if high < 10 else -0.2)
    tiles = palette.choose("roof")
    if style > 0.4:
        # A gable: a long box on its edge, whose lower half is in the house.
        side = (deep + 0.7) / 2**0.5
        parts = [Part(Box((wide - 0.04, side, side)), tiles, (0.0, 0.0, high), (float(np.pi / 4), 0.0, 0.0))]
        top = high + 0.5 * deep
    else:
        parts = [Part(Box((wide + 0.4, deep + 0.5, 0.5)), palette.choose("stone"), (0.0, 0.0, high))]
        if rng.random() < 0.5:
            size = (wide * rng.uniform(0.3, 0.8), 0.5 * deep, rng.uniform(1.5, 3.0))
            parts.append(Part(Box(size), palette.choose("stone"), (0.0, 0.2 * deep, high + size[2] / 2)))
        top = high + 0.6
    if rng.random() < 0.7:
        x = rng.uniform(-0.4, 0.4) * wide
        parts.append(Part(Box((0.6, 0.7, 2.4)), palette.choose("masonry"), (x, rng.uniform(-0.1, 0.2) * deep, top)))
    return parts


def _balcony(rng: np.random.Generator, palette: Palette, x: float, front: float, z: float) -> list[Part]:
    wide, deep = rng.uniform(1.6, 2.8), rng.uniform(0.7, 1.2)
    return [
        Part(Box((wide, deep, 0.18)), palette.choose("stone"), (x, front - deep / 2, z)),
        Part(Box((wide, 0.06, 0.9)), palette.choose("cargo"), (x, front - deep, z + 0.5)),
    ]


def _spread(rng: np.random.Generator, wide: float, count: int) -> np.ndarray:
    """Places along a front of that width."""
    return np.asarray((np.arange(count) + 0.5 + rng.uniform(-0.2, 0.2, count)) / count * wide - wide / 2) * 0.85

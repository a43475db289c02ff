"""A furnished room through which a camera is carried by hand."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.motion.random_motions import FreeSpace, pure_rotation, rolling
from sigmaslam_synthetic.motion.shaken import shaken
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel, Shape
from sigmaslam_synthetic.scene import Body, Lights, Material, Scene, Texture
from sigmaslam_synthetic.worlds.episode import Episode, Wish, carried
from sigmaslam_synthetic.worlds.part_models import Model, Part, follow

CLEARANCE = 0.3
"""Metres between the camera and any surface, at least."""

_SHAKE = 0.05  # metres that a shaken camera leaves its way
_DEPTH = 0.8  # metres off the walls that belong to furniture

# Tile in metres on small things and contrast of each kind: boards of 5-25 cm, tiles of 10-30 cm on floors and walls.
_LOOKS = {"bricks": (0.6, 0.8), "cells": (0.5, 0.7), "checker": (0.6, 0.6), "facade": (0.7, 1.0), "glyphs": (0.4, 1.0)}
_LOOKS |= {"leaves": (0.6, 0.8), "noise": (0.6, 0.7), "plaster": (0.9, 1.1), "stripes": (0.7, 0.6)}
_LOOKS |= {"strokes": (0.5, 0.9), "wood": (0.7, 1.0)}
_WALLS = ("plaster", "plaster", "bricks", "leaves", "checker", "wood", "stripes")
_FLOORS = ("wood", "wood", "bricks", "checker", "leaves", "cells", "strokes")
_WOODS = ("wood", "wood", "noise", "plaster")
_FABRICS = ("leaves", "checker", "cells", "strokes", "stripes")
_PRINTS = ("leaves", "leaves", "glyphs", "facade", "cells", "strokes", "stripes")
_UPRIGHT = Rotation.from_euler("x", -np.pi / 2)


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A room of 4-9 m with furniture along its walls and low things in its middle; a walk with a hand-held camera.

    The camera keeps `CLEARANCE` from everything that does not move.
    """
    size = np.array([rng.uniform(4.0, 9.0), rng.uniform(4.0, 7.0), rng.uniform(2.4, 3.2)])
    # Where the camera may be: in the middle of the room, off the furniture along the walls.
    room = size[:2] / 2 - CLEARANCE - _DEPTH - rng.uniform(0.05, 0.2, 2)
    half = np.append(np.minimum(room, 1.7) * rng.uniform(0.85, 1.0, 2), rng.uniform(0.1, 0.2))
    middle = np.append(rng.uniform(-1, 1, 2) * (room - half[:2]), rng.uniform(1.45, 1.65))
    free = FreeSpace(_triple(middle), _triple(half))
    furniture = _Furniture(rng, wish)
    for wall in range(4):
        _furnish_wall(furniture, wall, size)
    _lay_floor(furniture, size)
    _fill_middle(furniture, size, free)
    direction = _triple(rng.uniform((-0.8, -0.8, 0.7), (0.8, 0.8, 1.2)))
    lights = Lights(rng.uniform(0.2, 0.45), rng.uniform(0.3, 0.9), direction, shadows=bool(rng.random() < 0.85))
    way = _carry(rng, wish, free)
    path = shaken(rng, way, _SHAKE) if wish.motion == "shaken" else way
    if wish.movers > 0:
        models = [_passer_by(furniture) for _ in range(1 if wish.movers < 0.15 else int(rng.integers(1, 4)))]
        share = min(1.2 * wish.movers, 0.55)  # some of it will be behind furniture
        furniture.bodies += follow(rng, way, wish.duration, share, models, (0.7, 2.2))
    return Episode(Scene(tuple(furniture.bodies), tuple(furniture.materials), lights), path)


def _carry(rng: np.random.Generator, wish: Wish, free: FreeSpace) -> Path:
    """The camera's path but for the shaking."""
    if wish.motion == "rotation":
        return pure_rotation(rng, wish.duration, _triple(free.centre + rng.uniform(-0.8, 0.8, 3) * free.half))
    if wish.motion == "planar":
        return rolling(rng, wish.duration, free)
    return carried(rng, wish, free, _SHAKE)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


class _Furniture:
    """What stands in the room so far; pieces are built in a frame whose origin `stand` has set."""

    def __init__(self, rng: np.random.Generator, wish: Wish) -> None:
        self.rng = rng
        self.bodies: list[Body] = []
        self.materials: list[Material] = []
        self._seeds = {kind: [wish.texture(rng, kind, 1.0).seed] for kind in _LOOKS}
        self._seeds["leaves"].append(wish.texture(rng, "leaves", 1.0).seed)
        self.woods = [self.material(_WOODS, 0.2, 0.65) for _ in range(4)]
        self.fabrics = [self.material(_FABRICS, 0.2, 0.65) for _ in range(4)]
        self.prints = [self.material(_PRINTS, 0.2, 0.85) for _ in range(16)]
        self.metal = self.material(("noise",), 0.1, 0.7)
        self.green = self.material(("strokes",), 0.2, 0.4)

    def material(self, kinds: tuple[str, ...], dark: float, bright: float, scale: float = 1.0) -> int:
        """A new material of one of the kinds, on things `scale` times as large; noise makes it uneven."""
        kind = kinds[int(self.rng.integers(len(kinds)))]
        tile, contrast = np.array(_LOOKS[kind]) * (scale, 1.0) * np.exp(self.rng.uniform(-0.45, 0.45, 2))
        seed, uneven = self._seeds[kind][int(self.rng.integers(len(self._seeds[kind])))], self.rng.uniform(0.1, 0.4)
        layers = Texture(kind, seed, tile, contrast), Texture("noise", self._seeds["noise"][0], 2.3 * tile, uneven)
        self.materials.append(Material(self.rng.uniform(dark, bright), layers))
        return len(self.materials) - 1

    def stand(self, origin: np.ndarray, yaw: float) -> None:
        """Sets the frame of the pieces to come: x to the right, y forward, z up; yaw in radians."""
        self._origin, self._turn = origin, Rotation.from_euler("z", yaw)

    def add(self, shape: Shape, material: int, place: Sequence[float], turn: Rotation | None = None) -> None:
        """A body at a place of the frame, metres."""
        position = self._origin + self._turn.apply(place)
        rotation = self._turn if turn is None else self._turn * turn
        shadow = not isinstance(shape, Panel)  # light comes in through walls and ceiling
        self.bodies.append(Body(shape, material, _triple(position), _triple(rotation.as_rotvec()), shadow=shadow))

    def box(self, low: Sequence[float], high: Sequence[float], material: int) -> None:
        """A box between two corners."""
        self.add(Box(_triple(np.subtract(high, low))), material, (np.add(high, low) / 2).tolist())

    def pick(self, materials: list[int]) -> int:
        """One of the materials."""
        return materials[int(self.rng.integers(len(materials)))]

    def clutter(self, width: float, low: float, high: float, z: float, highest: float, count: int) -> None:
        """Small things on a board at height z, y from low to high: boxes, piles, mugs, bottles, balls."""
        rng = self.rng
        for k in range(count):
            x = width * ((k + rng.uniform(0.25, 0.75)) / count - 0.5)
            y = low + (high - low) * rng.uniform(0.2, 0.8)
            tall, side = min(highest, rng.uniform(0.05, 0.4)), rng.uniform(0.03, 0.14)
            material, kind, base = self.pick(self.prints), rng.random(), z
            turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
            if kind < 0.3:
                self.add(Box((side, rng.uniform(0.5, 1.5) * side, tall)), material, (x, y, z + tall / 2), turn)
            elif kind < 0.55:
                top = None if rng.random() < 0.6 else rng.uniform(0.3, 1.2) * side / 2
                self.add(Cylinder(side / 2, tall, top, 12), material, (x, y, z + tall / 2), turn)
            elif kind < 0.65:
                radius = min(0.6 * side, 0.49 * highest)
                self.add(Ellipsoid((radius, radius, radius), 10), material, (x, y, z + radius), turn)
            else:
                for thick in rng.uniform(0.012, 0.045, int(rng.integers(1, 6))).tolist():
                    size = rng.uniform(0.14, 0.3), rng.uniform(0.1, 0.22), min(thick, highest / 5)
                    turn = Rotation.from_euler("z", rng.uniform(-0.5, 0.5))
                    self.add(Box(size), self.pick(self.prints), (x, y, base + size[2] / 2), turn)
                    base += size[2]

    def books(self, half: float, back: float, z: float, highest: float) -> None:
        """A row of books on a board at height z, `half` to either side, and room where they end."""
        rng = self.rng
        x, end = -half, half * (1.0 - rng.uniform(0.0, 0.7))
        tall = rng.uniform(0.6, 0.85) * highest
        while x < end:
            thick, deep = (float(v) for v in rng.uniform((0.012, 0.12), (0.05, 0.2)))
            high = min(tall * rng.uniform(0.8, 1.1), highest)
            self.box((x, back, z), (min(x + thick, half), back + deep, z + high), self.pick(self.prints))
            x += thick + (0.001 if rng.random() < 0.93 else 0.04)


def _passer_by(f: _Furniture) -> Model:
    """A person, or a stack of parcels, about its middle."""
    first, second, third = (f.pick(f.fabrics + f.prints) for _ in range(3))
    if f.rng.random() < 0.4:
        return (Part(Box((0.5, 0.4, 0.35)), first), Part(Box((0.3, 0.42, 0.2)), second, (0.0, 0.0, 0.27)))
    trunk, head = Ellipsoid((0.22, 0.14, 0.36), 14), Ellipsoid((0.1, 0.12, 0.14), 12)
    parts = [Part(trunk, first, (0.0, 0.0, 0.15)), Part(head, second, (0.0, 0.0, 0.65))]
    for s, swing in ((-1.0, 0.3), (1.0, -0.3)):
        parts.append(Part(Cylinder(0.06, 0.8, 0.08), third, (0.1 * s, 0.0, -0.55), (swing, 0.0, 0.0)))
        parts.append(Part(Cylinder(0.045, 0.6), first, (0.27 * s, 0.0, 0.15), (-swing, -0.15 * s, 0.0)))
    return tuple(parts)


def _table(f: _Furniture, width: float, front: float, depth: float, height: float, highest: float) -> None:
    """A table about x = 0 from y = front on, with things on it up to `highest` above it."""
    wood, leg, x, back = f.pick(f.woods), f.rng.uniform(0.04, 0.08), width / 2, front + depth
    f.box((-x, front, height - 0.04), (x, back, height), f.pick(f.woods))
    for left in (-x + 0.03, x - 0.03 - leg):
        for y in (front + 0.03, back - 0.03 - leg):
            f.box((left, y, 0), (left + leg, y + leg, height - 0.04), wood)
    f.clutter(width, front, back, height, highest, int(f.rng.integers(4, 6 + int(6 * width))))


def _chair(f: _Furniture, height: float) -> None:
    """A chair about the origin that looks along y, `height` to the top of its back."""
    wood = f.pick(f.woods)
    f.box((-0.21, -0.21, 0.42), (0.21, 0.21, 0.46), f.pick(f.fabrics))
    for x in (-0.21, 0.17):
        f.box((x, 0.17, 0), (x + 0.036, 0.206, 0.42), wood)
        f.box((x, -0.206, 0), (x + 0.036, -0.17, height), wood)
    for z in np.linspace(0.54, height - 0.1, int(f.rng.integers(2, 5))).tolist():
        f.box((-0.19, -0.205, z), (0.19, -0.185, z + 0.08), wood)


def _cupboard(f: _Furniture, width: float, depth: float, height: float, things: float = 0.0) -> None:
    """A cupboard at the wall y = 0, with doors or drawers, knobs, and things on it up to a height."""
    body, front = f.pick(f.woods), f.pick(f.woods + f.fabrics)
    f.box((-width / 2, 0, 0), (width / 2, depth, height), body)
    f.box((-width / 2 + 0.01, depth, 0.08), (width / 2 - 0.01, depth + 0.015, height - 0.01), front)
    columns = max(1, round(width / f.rng.uniform(0.35, 0.6)))
    rows = max(1, round(height / f.rng.uniform(0.2, 1.2)))
    w, h, y = width / columns, (height - 0.08) / rows, depth + 0.02
    for i in range(columns):
        x = -width / 2 + i * w
        f.box((x - 0.012, depth, 0.05), (x + 0.012, y, height), body)
        for j in range(rows):
            z = 0.08 + j * h
            f.box((x + 0.012, depth, z - 0.01), (x + w - 0.012, y, z + 0.01), body)
            knob = x + (0.5 if rows > 1 else 0.15 + 0.7 * (i % 2)) * w
            f.box((knob - 0.03, y, z + h / 2 - 0.01), (knob + 0.03, y + 0.02, z + h / 2 + 0.01), f.metal)
    if things > 0:
        f.clutter(width, 0.0, depth, height, things, int(3 + 4 * width))


def _shelf(f: _Furniture, width: float, depth: float, height: float, boards: int, z: float = 0.0) -> None:
    """A shelf at the wall y = 0 from z on upwards, with books and things."""
    wood, gap, side = f.pick(f.woods), (height - 0.03) / boards, width / 2
    f.box((-side, 0, z), (side, 0.012, z + height), wood)
    f.box((-side, 0, z), (-side + 0.025, depth, z + height), wood)
    f.box((side - 0.025, 0, z), (side, depth, z + height), wood)
    for level in (z + gap * np.arange(boards + 1)).tolist():
        f.box((-side + 0.025, 0.012, level), (side - 0.025, depth - 0.004, level + 0.025), wood)
        if level > z + height - gap:
            break
        if f.rng.random() < 0.75:
            f.books(side - 0.03, f.rng.uniform(0.02, 0.08), level + 0.025, gap - 0.04)
        else:
            f.clutter(width - 0.1, 0.0, depth, level + 0.025, gap - 0.05, int(3 + 5 * width))


def _plant(f: _Furniture, y: float, height: float, reach: float) -> None:
    """A pot with leaves at (0, y), all within `reach` of its middle."""
    rng, pot = f.rng, 0.4 * reach + 0.02 * height
    f.add(Cylinder(0.75 * pot, 2 * pot, pot, 16), f.pick(f.prints), (0.0, y, pot))
    f.add(Cylinder(0.02, 0.9 * height - pot, 0.01, 8), f.pick(f.woods), (0.0, y, pot + (0.9 * height - pot) / 2))
    for _ in range(int(rng.integers(9, 18))):
        lift, around, share = rng.uniform((2 * pot, -np.pi, 0.5), (0.95 * height, np.pi, 1.0)).tolist()
        long, c, s = 0.5 * share * reach, np.cos(around), np.sin(around)
        out, turn = rng.uniform(0.7 * long, reach - long), Rotation.from_euler("zy", [around, rng.uniform(-0.9, 0.5)])
        f.add(Ellipsoid((long, 0.4 * long, 0.05 * long), 6), f.green, (out * c, y + out * s, lift), turn)


def _floor_lamp(f: _Furniture, y: float, height: float) -> None:
    """A lamp on a pole at (0, y)."""
    radius = f.rng.uniform(0.12, 0.22)
    f.box((-0.13, y - 0.13, 0), (0.13, y + 0.13, 0.02), f.metal)
    f.add(Cylinder(0.015, height - 0.2, None, 8), f.metal, (0.0, y, height / 2 - 0.08))
    f.add(Cylinder(radius, 0.28, f.rng.uniform(0.5, 1.0) * radius, 20), f.pick(f.fabrics), (0.0, y, height - 0.14))


def _sofa(f: _Furniture, width: float, depth: float) -> None:
    """A sofa at the wall y = 0 with cushions."""
    fabric = f.pick(f.fabrics)
    f.box((-width / 2, 0, 0.05), (width / 2, depth, 0.42), fabric)
    f.box((-width / 2, 0, 0.42), (width / 2, 0.2, 0.8), fabric)
    for x in np.arange(-width / 2 + 0.3, width / 2 - 0.25, f.rng.uniform(0.35, 0.6)):
        turn = Rotation.from_euler("xz", [-0.35, f.rng.uniform(-0.4, 0.4)])
        f.add(Ellipsoid((0.2, 0.07, 0.19), 12), f.pick(f.prints), (float(x), 0.3, 0.6), turn)


def _picture(f: _Furniture, x: float, z: float, width: float, height: float, material: int) -> None:
    """A framed picture on the wall y = 0."""
    edge, wood = f.rng.uniform(0.015, 0.05), f.pick([*f.woods, f.metal])
    f.box((x - width / 2, 0, z - height / 2), (x + width / 2, 0.02, z + height / 2), wood)
    f.add(Panel(width - 2 * edge, height - 2 * edge), material, (x, 0.024, z), _UPRIGHT)


def _window(f: _Furniture, low: float, width: float, height: float) -> None:
    """A window with bars, a sill and perhaps curtains on the wall y = 0."""
    _picture(f, 0.0, low + height / 2, width, height, f.material(("facade", "leaves"), 0.6, 0.9, 3.0))
    frame, side = f.pick(f.woods), width / 2
    for x in np.linspace(-side, side, int(f.rng.integers(1, 4)) + 2)[1:-1].tolist():
        f.box((x - 0.02, 0.02, low), (x + 0.02, 0.05, low + height), frame)
    f.box((-side, 0.02, low + 0.6 * height), (side, 0.045, low + 0.6 * height + 0.05), frame)
    f.box((-side - 0.05, 0, low - 0.04), (side + 0.05, 0.16, low), f.pick(f.woods))
    if f.rng.random() < 0.5:
        cloth = f.pick(f.fabrics)
        for x in np.outer((-1, 1), side + 0.1 - 0.07 * np.arange(6)).ravel().tolist():
            f.add(Cylinder(0.045, height + 0.4, None, 10), cloth, (x, 0.1, low + height / 2))


def _door(f: _Furniture) -> None:
    """A door with panels, a frame and a handle in the wall y = 0."""
    inlay = f.pick(f.woods)
    f.box((-0.52, 0, 0), (0.52, 0.02, 2.08), f.pick(f.woods))
    f.box((-0.44, 0.02, 0.01), (0.44, 0.04, 2.0), f.pick(f.woods))
    for x, z in ((-0.36, 0.2), (0.04, 0.2), (-0.36, 1.1), (0.04, 1.1)):
        f.box((x, 0.04, z), (x + 0.32, 0.05, z + 0.7), inlay)
    f.box((0.27, 0.06, 1.0), (0.4, 0.08, 1.02), f.metal)


def _furnish_wall(f: _Furniture, wall: int, size: np.ndarray) -> None:
    """A wall with all that stands at it and hangs on it; walls 0 to 3 look along y, -x, -y, x."""
    rng, yaw = f.rng, 0.5 * np.pi * wall
    inward = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    length, height = (size[0] if wall % 2 == 0 else size[1]), size[2]
    foot = -np.abs(inward @ np.append(size[:2], 0.0)) / 2 * inward
    f.stand(foot, yaw)
    f.add(Panel(length, height), f.material(_WALLS, 0.35, 0.8, 3.0), (0.0, 0.0, height / 2), _UPRIGHT)
    f.box((-length / 2, 0, 0), (length / 2, 0.015, rng.uniform(0.06, 0.15)), f.pick(f.woods))
    end = length / 2 - (0.1 if wall % 2 == 0 else _DEPTH + 0.1)
    at = -end
    while at < end - 0.5:
        width = min(rng.uniform(0.5, 1.7), end - at)
        f.stand(foot + (at + width / 2) * along, yaw)
        top = _put(f, width, height)
        if top < 1.3:
            _hang(f, width, max(top + 0.15, 0.9), height - 0.15)
        at += width + (rng.uniform(0.02, 0.15) if rng.random() < 0.7 else rng.uniform(0.2, 0.6))


def _put(f: _Furniture, width: float, height: float) -> float:
    """A piece of furniture at the wall y = 0, no wider than `width`; returns its height."""
    rng, kind, depth = f.rng, f.rng.random(), f.rng.uniform(0.25, 0.5)
    tall, low = rng.uniform((1.5, 0.5), (min(2.2, height - 0.1), 1.0)).tolist()
    pieces: tuple[tuple[float, float, float, Callable[[], None]], ...] = (
        (0.2, 0.0, tall, lambda: _shelf(f, width, depth, tall, int(rng.integers(4, 7)))),
        (0.3, 0.0, tall, lambda: _cupboard(f, width, depth, tall)),
        (0.36, 1.1, 2.1, lambda: _door(f)),
        (0.55, 0.0, low, lambda: _cupboard(f, width, depth, low, things=0.5)),
        (0.68, 0.9, 0.75, lambda: _table(f, width, 0.05, 0.6, 0.75, 0.5)),
        (0.78, 1.0, 0.8, lambda: _sofa(f, width, 0.75)),
        (0.88, 0.5, low + 0.7, lambda: _plant(f, 0.4, low + 0.7, 0.4)),
        (0.94, 0.0, tall - 0.1, lambda: _floor_lamp(f, 0.3, tall - 0.1)),
    )
    for share, narrowest, top, build in pieces:
        if kind < share and width >= narrowest:
            build()
            return top
    return 0.0


def _hang(f: _Furniture, width: float, low: float, high: float) -> None:
    """What hangs on the wall y = 0 between two heights."""
    rng, kind = f.rng, f.rng.random()
    if kind < 0.3:
        _window(f, low + 0.1, 0.85 * width, rng.uniform(0.7, 1.0) * (high - low - 0.4))
    elif kind < 0.5:
        _shelf(f, 0.9 * width, 0.22, min(0.75, high - low - 0.25), 2, low + 0.25)
    elif kind < 0.7:
        tall = min(high - low, rng.uniform(0.6, 1.0))
        f.add(Panel(0.9 * min(width, tall), tall), f.pick(f.prints), (0.0, 0.012, (low + high) / 2), _UPRIGHT)
    else:
        step = rng.uniform(0.3, 0.5)
        for x in np.arange(-width / 2 + 0.2, width / 2 - 0.1, step):
            for z in np.arange(low + 0.3, high - 0.2, step * rng.uniform(1.0, 1.5)):
                if rng.random() < 0.85:
                    w, h = rng.uniform(0.5, 0.92, 2) * step
                    _picture(f, float(x), float(z), w, h, f.pick(f.prints))


def _lay_floor(f: _Furniture, size: np.ndarray) -> None:
    """Floor and ceiling, with lamps and rugs."""
    rng, (width, depth, height) = f.rng, size.tolist()
    f.stand(np.zeros(3), 0.0)
    f.add(Panel(width, depth), f.material(_FLOORS, 0.2, 0.6, 2.5), (0.0, 0.0, 0.0))
    f.add(Panel(width, depth), f.material(_WALLS[:4], 0.5, 0.85, 3.0), (0.0, 0.0, height))
    for _ in range(int(rng.integers(1, 4))):
        place = (rng.uniform(-0.4, 0.4) * width, rng.uniform(-0.4, 0.4) * depth, height - 0.05)
        f.add(Cylinder(rng.uniform(0.1, 0.25), 0.1, None, 20), f.pick([*f.fabrics, f.metal]), place)
    for k in range(int(rng.integers(1, 4))):
        place = (rng.uniform(-0.25, 0.25) * width, rng.uniform(-0.25, 0.25) * depth, 0.004 + 0.003 * k)
        turn = Rotation.from_euler("z", rng.uniform(-0.4, 0.4))
        rug = Box((*rng.uniform(0.8, 2.4, 2).tolist(), 0.008 + 0.006 * k))
        f.add(rug, f.material(_FABRICS, 0.2, 0.6, 2.0), place, turn)


def _fill_middle(f: _Furniture, size: np.ndarray, free: FreeSpace) -> None:
    """Tables and chairs below the camera's way, and tall things beside it."""
    rng, reach = f.rng, size[:2] / 2 - _DEPTH
    centre, half = np.array(free.centre), np.array(free.half)
    highest = centre[2] - half[2] - CLEARANCE
    taken: list[tuple[np.ndarray, float]] = []
    for _ in range(60):
        tall, radius = rng.random() < 0.35, rng.uniform(0.25, 0.85)
        place = rng.uniform(-1, 1, 2) * (reach - radius)
        distance = np.linalg.norm(np.maximum(np.abs(place - centre[:2]) - half[:2], 0.0))
        if tall and distance < radius + CLEARANCE + 0.15:  # room for the right camera too
            continue
        crowded = len(taken) > 2 + size[0] * size[1] / 5
        if crowded or any(np.linalg.norm(place - other) < radius + r for other, r in taken):
            continue
        taken.append((place, radius))
        f.stand(np.append(place, 0.0), rng.uniform(-np.pi, np.pi))
        kind = rng.random()
        if tall and kind < 0.4:
            _shelf(f, 1.3 * radius, min(0.3, 0.7 * radius), rng.uniform(1.3, 2.0), 5)
        elif tall and kind < 0.7:
            _plant(f, 0.0, rng.uniform(1.0, 1.9), min(radius, 0.5))
        elif tall:
            _floor_lamp(f, 0.0, rng.uniform(1.3, 1.9))
        elif radius > 0.5 and kind < 0.75:
            _table(f, 1.5 * radius, -0.55 * radius, 1.1 * radius, rng.uniform(0.4, 0.76), min(0.45, highest - 0.76))
        elif kind < 0.85:
            _chair(f, min(rng.uniform(0.8, 0.95), highest))
        else:
            f.add(Box((radius, radius, 0.4)), f.pick(f.fabrics), (0.0, 0.0, 0.2))
            f.clutter(radius, -radius / 2, radius / 2, 0.4, highest - 0.4, 3)

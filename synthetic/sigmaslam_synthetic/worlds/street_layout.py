"""What stands where along a road."""

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel
from sigmaslam_synthetic.scene import Body
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, stand
from sigmaslam_synthetic.worlds.street_furniture import (
    bush,
    car,
    lamp_post,
    person,
    shelter,
    sign,
    small_thing,
    tree,
    van,
)
from sigmaslam_synthetic.worlds.street_houses import house, wall
from sigmaslam_synthetic.worlds.street_road import Road, footprint

_HALF_LANE = 1.9  # metres from the middle of a lane to its edge
_CLEAR = 1.75  # nearest that anything stands to the middle of a lane
_KERB = 0.12

Maker = Callable[[np.random.Generator, Palette], Model]


class Street:
    """Lays out one street.

    Args:
        road: along which.

    Attributes:
        bodies: what was built so far.
    """

    def __init__(self, rng: np.random.Generator, road: Road, palette: Palette) -> None:
        self.bodies: list[Body] = []
        self._rng, self._road, self._palette = rng, road, palette
        self._city = rng.random() < 0.6  # closed rows of high houses, or gardens
        self._parking = (rng.random(2) < 0.65) * 2.1
        # From the middle of the driven lane to the kerb: right, left.
        self._kerb = _HALF_LANE + self._parking + [0.0, road.opposite]
        self._pavement = rng.uniform(1.6, 3.0, 2) if self._city else rng.uniform(1.2, 2.0, 2)
        # A long drive has fewer things to the metre, so that it stays quick to render.
        self._sparse = max(1.0, road.length / 260.0) ** 0.6

    def clear(self, place: np.ndarray, radius: float) -> None:
        """Keeps a disc free of whatever stands."""
        self._road.claim(footprint(place, 0.0, 2 * radius, 2 * radius), -1.0)

    def build(self) -> None:
        """Builds all of it."""
        road, palette = self._road, self._palette
        self.bodies += road.terrain(palette.choose("road"), palette.choose("land"))
        self._mark()
        for hand in (-1, 1):
            self._pave(hand)
            self._park(hand)
            self._furnish(hand)
        for hand in (-1, 1):
            self._settle(hand)
        self._close()
        self._second_row()
        self._skyline()

    def _mark(self) -> None:
        """Lane marks, patches and covers on the road."""
        rng, road, palette = self._rng, self._road, self._palette
        middle = road.opposite / 2 if road.opposite else _HALF_LANE - 0.15
        step = rng.uniform(4.5, 9.0)
        paint = palette.choose("mark")
        for s in np.arange(0.0, road.length, step):
            self._lay(s, middle, Panel(rng.uniform(1.5, 0.5 * step), 0.13), paint, 0.008)
        if rng.random() < 0.5:
            for s in np.arange(0.0, road.length, 4.0):
                self._lay(s, -_HALF_LANE + 0.2, Panel(4.0, 0.1), paint, 0.006)
        for s in np.arange(0.0, road.length, 6.5 * self._sparse) + rng.uniform(0, 5):
            left = rng.uniform(-_HALF_LANE, self._kerb[1] - 0.5)
            patch = Panel(rng.uniform(0.4, 4.0), rng.uniform(0.3, 1.6))
            self._lay(s, left, patch, palette.choose("patch"), rng.uniform(0.002, 0.004))
            if rng.random() < 0.4:
                place, yaw = road.at(s + 2.0, rng.uniform(-1.2, 1.2))
                T = road.pose(place, float(yaw), 0.7, 0.003)
                self._put(Cylinder(0.32, 0.01, None, 7), palette.choose("stone"), T, shadow=False)
        for s in np.arange(25.0, road.length, 60.0) + rng.uniform(-10, 30):  # crossings
            if rng.random() < 0.6:
                for left in np.arange(-_HALF_LANE + 0.4, self._kerb[1], 1.0):
                    self._lay(s, left, Panel(3.0, 0.5), paint, 0.009)

    def _pave(self, hand: int) -> None:
        """Raised pavements with kerbs, and the yards behind them; now and then a side street leaves a gap."""
        rng, road, palette = self._rng, self._road, self._palette
        side = int(hand > 0)
        kerb, wide = self._kerb[side], self._pavement[side]
        slab, gap_at = palette.choose("pavement"), rng.uniform(30, 90)
        s = 0.0
        while s < road.length:
            long = rng.uniform(4.5, 5.5)
            if s > gap_at:
                s, gap_at = s + rng.uniform(6, 9), s + rng.uniform(50, 120)
                slab = palette.choose("pavement")
            for offset, width, material, top in (
                (kerb, wide, slab, _KERB),
                (kerb + wide, rng.uniform(5.0, 7.5), palette.choose("yard"), _KERB + rng.uniform(-0.06, 0.05)),
            ):
                place, yaw = road.at(s + long / 2, hand * (offset + width / 2))
                while width > 1.0 and road.distance(footprint(place, float(yaw), long, width)).min() < _CLEAR:
                    # Narrowed from without where a bend or another stretch of the road comes near.
                    width -= 1.0
                    place, yaw = road.at(s + long / 2, hand * (offset + width / 2))
                if width > 1.0:
                    T = road.pose(place, float(yaw), long, top - 0.25 + rng.uniform(-0.008, 0.008))
                    self._put(Box((long + rng.uniform(0.05, 0.3), width, 0.5)), material, T, shadow=False)
            s += long

    def _park(self, hand: int) -> None:
        rng, road = self._rng, self._road
        side = int(hand > 0)
        if not self._parking[side]:
            return
        left = hand * (self._kerb[side] - 1.0)
        s = rng.uniform(0, 8)
        while s < road.length:
            if rng.random() < 0.75:
                model = car(rng, self._palette) if rng.random() < 0.85 else van(rng, self._palette)
                flip = np.pi * (rng.random() < 0.5)
                self._stand(model, s, left + rng.uniform(-0.1, 0.1), 4.9, 1.75, turn=rng.normal(0, 0.02) + flip)
            s += rng.uniform(5.4, 8.5) * self._sparse**1.2

    def _furnish(self, hand: int) -> None:
        """What stands on the pavement."""
        rng, road = self._rng, self._road
        side = int(hand > 0)
        edge, wide = self._kerb[side] + 0.4, self._pavement[side]
        makers: list[tuple[Maker, float, float]] = [
            (lamp_post, 0.2, 0.15),
            (sign, 0.22, 0.0),
            (small_thing, 0.24, 0.45),
            (tree, 0.2 if self._city else 0.28, 0.5),
            (person, 0.1, 0.8),
            (shelter, 0.03, 0.9),
        ]
        weights = np.array([weight for _, weight, _ in makers])
        s = rng.uniform(0, 6)
        while s < road.length:
            maker, _, inwards = makers[int(rng.choice(len(makers), p=weights / weights.sum()))]
            left = hand * (edge + inwards + rng.uniform(0, 0.4) * wide)
            size = 3.2 if maker is shelter else 1.0
            # Lamps reach over the road, benches look at it, signs face those who come.
            turn = (0.0 if hand > 0 else np.pi) if maker is not sign else (np.pi if hand > 0 else 0.0)
            turn += rng.normal(0, 0.1)
            self._stand(maker(rng, self._palette), s, left, size, 0.5, turn=turn, above=_KERB)
            s += rng.uniform(3.0, 8.0) * self._sparse**1.2

    def _settle(self, hand: int) -> None:
        """Houses, and what is in front of and between them."""
        rng, road, palette = self._rng, self._road, self._palette
        side = int(hand > 0)
        front = self._kerb[side] + self._pavement[side]
        s = 0.0
        row = rng.uniform(10, 18) if self._city else rng.uniform(6, 9.5)
        while s < road.length:
            wide = rng.uniform(8, 16) if self._city else rng.uniform(7, 12)
            deep = rng.uniform(8, 12)
            set_back = rng.uniform(0.2, 1.5) if self._city else rng.uniform(2.2, 5.0)
            high = max(4.5, row * rng.uniform(0.75, 1.35))
            if rng.random() < 0.1:
                row = rng.uniform(10, 20) if self._city else rng.uniform(6, 10)
            turn = 0.0 if hand > 0 else np.pi
            for width in (wide, 0.6 * wide):
                left = hand * (front + set_back + deep / 2)
                place, yaw = road.at(s + width / 2, left)
                marks = footprint(place, float(yaw), width - 0.4, deep)
                if road.claim(marks, max(front - road.opposite * side - 1.2, 3.2)):
                    model = house(rng, palette, width, deep, high, 1.0 / self._sparse)
                    z = float(road.ground(marks).mean())
                    T = road.pose(place, float(yaw) + turn)
                    T[:3, :3] = Rotation.from_euler("z", float(yaw) + turn).as_matrix()
                    T[2, 3] = z
                    self.bodies += stand(model, T)
                    wide = width
                    break
            else:
                wide = 5.0
                self._plant(s, hand, front + 0.8, wide)
            if set_back > 2.0:
                self._plant(s, hand, front, wide)
            gap = rng.uniform(0.0, 0.3) if self._city and rng.random() < 0.8 else rng.uniform(2.0, 5.0)
            if gap > 1.5:
                self._stand(wall(rng, palette, gap), s + wide + gap / 2, hand * (front + 1.5), gap, 0.4, turn=turn)
                if rng.random() < 1.0 / self._sparse:
                    self._stand(tree(rng, palette), s + wide + gap / 2, hand * (front + 4.5), 1.0, 1.0)
            s += wide + gap

    def _plant(self, s: float, hand: int, front: float, wide: float) -> None:
        """A front garden."""
        rng, palette = self._rng, self._palette
        turn = 0.0 if hand > 0 else np.pi
        pieces = max(1, round(wide / 5))
        for k in range(pieces):
            if rng.random() < 0.8 / self._sparse:
                long = wide / pieces - 0.3
                at = s + (k + 0.5) * wide / pieces
                self._stand(wall(rng, palette, long), at, hand * (front + 0.4), long, 0.5, turn=turn, above=_KERB)
        for _ in range(int(rng.integers(1, 3) / self._sparse + 0.5)):
            model = bush(rng, palette) if rng.random() < 0.7 else tree(rng, palette)
            self._stand(model, s + rng.uniform(0, 1) * wide, hand * (front + rng.uniform(1.2, 2.5)), 0.9, 0.9)

    def _close(self) -> None:
        """Houses across the road where it leaves the drive behind."""
        rng, road, palette = self._rng, self._road, self._palette
        for s, turn in ((-5.0, np.pi / 2), (road.length + 5.0, -np.pi / 2)):
            for left in (-16.0, 0.0, 16.0):
                place, yaw = road.at(s, left + rng.uniform(-2, 2))
                marks = footprint(place, float(yaw) + turn, 15.5, 9.0)
                if road.claim(marks, 0.3):
                    T = road.pose(place, float(yaw) + turn)
                    T[:3, :3] = Rotation.from_euler("z", float(yaw) + turn).as_matrix()
                    self.bodies += stand(house(rng, palette, 15.5, 9.0, rng.uniform(8, 15), 1.0), T)

    def _second_row(self) -> None:
        """Taller blocks and trees behind the first houses, seen through the gaps."""
        rng, road, palette = self._rng, self._road, self._palette
        for s in np.arange(0.0, road.length, 14.0 * self._sparse):
            for hand in (-1, 1):
                place, yaw = road.at(s, hand * rng.uniform(26, 48))
                if rng.random() < 0.6:
                    size = (rng.uniform(12, 22), rng.uniform(8, 14), rng.uniform(12, 28))
                    if road.claim(footprint(place, float(yaw), size[0], size[1]), 15.0):
                        T = road.pose(place, float(yaw), above=size[2] / 2 - 2.0)
                        self._put(Box(size), palette.choose("facade"), T)
                elif road.claim(footprint(place, 0.0, 4.0, 4.0), 12.0):
                    radii = (rng.uniform(2.5, 4.5), rng.uniform(2.5, 4.5), rng.uniform(3.5, 6.5))
                    T = road.pose(place, float(yaw), above=0.7 * radii[2])
                    self._put(Ellipsoid(radii, 4), palette.choose("leaves"), T)

    def _skyline(self) -> None:
        """Hills and high houses far off."""
        rng, road, palette = self._rng, self._road, self._palette
        count = 16 + int(road.length / 60)
        low, high = road.points.min(axis=0) - 160, road.points.max(axis=0) + 160
        places = rng.uniform(low, high, (20 * count, 2))
        away = road.distance(places)
        for place in places[(away > 75) & (away < 190)][:count]:
            z = float(road.ground(place[None])[0])
            if rng.random() < 0.6:
                size = (rng.uniform(12, 40), rng.uniform(12, 30), rng.uniform(25, 60))
                self._put(Box(size), palette.choose("facade"), _upright(place, z + size[2] / 2 - 6, rng))
            else:
                radii = (rng.uniform(25, 60), rng.uniform(25, 60), rng.uniform(12, 26))
                self._put(Ellipsoid(radii, 6), palette.choose("land"), _upright(place, z - 1, rng))

    def _stand(
        self, model: Model, s: float, left: float, long: float, wide: float, *, turn: float = 0.0, above: float = 0.0
    ) -> None:
        """Puts a model beside the road unless its place is taken or in a lane."""
        place, heading = self._road.at(s, left)
        yaw = float(heading) + turn
        if self._road.claim(footprint(place, yaw, long, wide), _CLEAR):
            self.bodies += stand(model, self._road.pose(place, yaw, long, above))

    def _lay(self, s: float, left: float, panel: Panel, material: int, above: float) -> None:
        """Puts a panel on the road, just above all of the ground beneath it."""
        place, heading = self._road.at(s, left)
        marks = footprint(place, float(heading), panel.width, panel.height)
        T = self._road.pose(place, float(heading), panel.width)
        local = (marks - place) @ T[:2, :2] / (T[:2, :2] ** 2).sum(axis=0)
        plane = T[2, 3] + local @ T[2, :2]
        T[2, 3] += above + float((self._road.ground(marks) - plane).max())
        self._put(panel, material, T, shadow=False)

    def _put(
        self, shape: Box | Cylinder | Ellipsoid | Panel, material: int, T: np.ndarray, *, shadow: bool = True
    ) -> None:
        yaw, pitch = math.atan2(T[1, 0], T[0, 0]), -math.asin(min(max(T[2, 0], -1.0), 1.0))
        # Quaternion of a turn about y, then about z.
        c, s, cp, sp = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), math.sin(pitch / 2)
        x, y, z, w = -s * sp, c * sp, s * cp, c * cp
        sine = math.sqrt(x * x + y * y + z * z)
        angle = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
        rotation = (angle * x, angle * y, angle * z)
        self.bodies.append(Body(shape, material, tuple(T[:3, 3].tolist()), rotation, shadow=shadow))


def _upright(place: np.ndarray, z: float, rng: np.random.Generator) -> np.ndarray:
    return rigid_motion(Rotation.from_euler("z", rng.uniform(0, np.pi)).as_matrix(), [*place, z])

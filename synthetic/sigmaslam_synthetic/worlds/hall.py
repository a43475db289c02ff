"""A drone's flight through a machine hall or a yard with containers."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion import random_motions
from sigmaslam_synthetic.motion.paths import Path, at_rest, with_stops
from sigmaslam_synthetic.motion.shaken import shaken, slowed
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel
from sigmaslam_synthetic.scene import Body, Scene
from sigmaslam_synthetic.worlds.episode import Episode, Wish, daylight
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, Part, bounds, centred, follow, stand
from sigmaslam_synthetic.worlds.street_furniture import person

_CLEARANCE = 0.7
"""Metres around the camera's way that stay free."""
_SHAKE = 0.08  # metres that a shaken camera leaves its way
_FREE_FOR_MOVERS = 0.8  # more of it where bodies fly about in front of the camera


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A hall of 12-30 m full of machines, shelves, pipes and crates, or a yard; a drone flies through what is free."""
    outdoors = bool(rng.random() < 0.25)
    size = np.array([rng.uniform(12, 30), rng.uniform(12, 22), rng.uniform(5.5, 9.0)])
    clearance = _CLEARANCE + _FREE_FOR_MOVERS * (wish.movers > 0)
    way = _flight(rng, wish, size, clearance)
    path = shaken(rng, way, _SHAKE) if wish.motion == "shaken" else way
    hall = Hall(rng, wish, size, path, clearance, outdoors)
    hall.build()
    bodies = hall.bodies
    if wish.movers > 0:
        makers = (hall.load, hall.flying_machine, hall.crates)
        models = [makers[int(rng.integers(3))]() for _ in range(1 + int(rng.random() < 0.6) + int(wish.movers > 0.2))]
        bodies += follow(rng, way, wish.duration, wish.movers, [centred(m) for m in models], (0.6, 1.4))
    lights = daylight(rng, 25, (0.6, 1.2))
    return Episode(Scene(tuple(bodies), tuple(hall.palette.materials), lights, sky=float(rng.uniform(0.8, 2.2))), path)


class Hall:
    """Fills a hall around a flight.

    Args:
        wish: whose textures are used.
        size: metres along x, y, z; the floor's middle is the origin.
        path: of the camera.
        clearance: metres around the path that stay free.
        outdoors: a yard without a ceiling.

    Attributes:
        bodies: what was built so far.
    """

    def __init__(
        self, rng: np.random.Generator, wish: Wish, size: np.ndarray, path: Path, clearance: float, outdoors: bool
    ) -> None:
        self.bodies: list[Body] = []
        self.palette = Palette(rng, wish, "hall")
        self._rng, self._size, self._outdoors, self._clearance = rng, size, outdoors, clearance
        count = int(path.end / 0.08) + 2
        self._way = path.poses(np.linspace(0.0, path.end, count))[:, :3, 3]
        self._boxes = np.zeros((0, 2, 3))  # lowest and highest corners of what stands

    def build(self) -> None:
        """Builds all of it."""
        self._shell()
        if not self._outdoors:
            self._ceiling()
        area = self._size[0] * self._size[1]
        floor: list[tuple[Callable[[], Model], int]] = [
            (self.shelf, int(area / 45)),
            (self.machine, int(area / 22)),
            (self.tank, int(area / 60)),
            (self.crates, int(area / 22)),
            (lambda: person(self._rng, self.palette), 3),
        ]
        for maker, count in floor:
            for _ in range(count):
                self._try_floor(maker)
        for _ in range(int(area / 12)):
            self._try_wall()
        for _ in range(int(area / 30) if not self._outdoors else 4):
            self._try_air()

    def shelf(self) -> Model:
        """A rack with boards and boxes."""
        rng, p = self._rng, self.palette
        long, deep, high = rng.uniform(1.8, 4.0), rng.uniform(0.5, 0.9), rng.uniform(1.8, 4.0)
        metal = p.choose("metal")
        parts = [
            Part(Box((0.07, 0.07, high)), metal, (x * long, y * deep, high / 2))
            for x in (-0.5, 0.5)
            for y in (-0.5, 0.5)
        ]
        for z in np.arange(0.15, high, rng.uniform(0.7, 1.1)).tolist():
            parts.append(Part(Box((long, deep, 0.05)), p.choose("wood"), (0.0, 0.0, z)))
            x = -long / 2 + 0.1
            while x < long / 2 - 0.3:
                w, h = rng.uniform(0.2, 0.7), rng.uniform(0.15, 0.6)
                if rng.random() < 0.75:
                    box = Box((min(w, long / 2 - x), deep * rng.uniform(0.5, 0.95), h))
                    parts.append(Part(box, p.choose("crate"), (x + box.size[0] / 2, 0.0, z + 0.026 + h / 2)))
                x += w + rng.uniform(0.02, 0.2)
        return tuple(parts)

    def machine(self) -> Model:
        """A block with panels, knobs, pipes and a rounded part."""
        rng, p = self._rng, self.palette
        x, y, z = rng.uniform(0.8, 2.4), rng.uniform(0.7, 1.6), rng.uniform(0.8, 2.6)
        body, metal = p.choose("machine"), p.choose("metal")
        parts = [
            Part(Box((x, y, z)), body, (0.0, 0.0, z / 2)),
            Part(Box((1.1 * x, 1.1 * y, 0.12)), p.choose("stone"), (0.0, 0.0, 0.06)),
            Part(Box((0.5 * x, 0.06, 0.4 * z)), p.choose("writing"), (0.1 * x, -y / 2, 0.6 * z)),
            Part(Box((0.3 * x, 0.3, 0.35 * z)), p.choose("machine"), (-0.3 * x, -y / 2 - 0.1, 0.4 * z)),
            Part(Cylinder(0.2 * y, 0.7, None, 10), metal, (0.25 * x, 0.0, z + 0.35)),
        ]
        for k in range(int(rng.integers(2, 6))):
            parts.append(Part(Box((0.08, 0.08, 0.08)), p.choose("sign"), (-0.1 * x + 0.14 * k, -y / 2 - 0.05, 0.3 * z)))
        if rng.random() < 0.6:
            turn = (0.0, float(np.pi / 2), 0.0)
            parts.append(Part(Cylinder(0.28 * z, 0.5 * x, None, 12), metal, (0.75 * x, 0.0, 0.4 * z), turn))
            parts.append(Part(Cylinder(0.06, 1.2 * x, None, 6), p.choose("metal"), (0.0, y / 2 + 0.1, 0.8 * z), turn))
        if rng.random() < 0.4:
            parts.append(Part(Ellipsoid((0.3 * x, 0.4 * y, 0.35), 8), p.choose("machine"), (-0.2 * x, 0.0, z)))
        return tuple(parts)

    def tank(self) -> Model:
        """An upright tank with domed ends, legs and a ladder."""
        rng, p = self._rng, self.palette
        radius, high = rng.uniform(0.5, 1.3), rng.uniform(1.2, 3.2)
        skin, metal = p.choose("machine"), p.choose("metal")
        parts = [
            Part(Cylinder(radius, high, None, 16), skin, (0.0, 0.0, 0.6 + high / 2)),
            *(Part(Ellipsoid((radius, radius, 0.4 * radius), 8), skin, (0.0, 0.0, z)) for z in (0.6, 0.6 + high)),
            Part(Cylinder(1.03 * radius, 0.08, None, 16), metal, (0.0, 0.0, 0.6 + rng.uniform(0.3, 0.7) * high)),
            Part(Cylinder(0.1, 0.9, None, 8), metal, (0.0, 0.0, 1.0 + high)),
        ]
        for k in range(3):
            a = 2 * np.pi * k / 3
            parts.append(
                Part(Box((0.12, 0.12, 0.9)), metal, (0.8 * radius * np.cos(a), 0.8 * radius * np.sin(a), 0.45))
            )
        for z in np.arange(0.4, high, 0.35).tolist():
            parts.append(Part(Box((0.05, 0.4, 0.04)), p.choose("sign"), (-radius - 0.12, 0.0, 0.4 + z)))
        return tuple(parts)

    def crates(self) -> Model:
        """A pile of crates or a barrel or two."""
        rng, p = self._rng, self.palette
        if rng.random() < 0.3:
            return tuple(
                Part(Cylinder(0.29, 0.88, None, 10), p.choose("machine"), (0.65 * k, rng.uniform(-0.1, 0.1), 0.44))
                for k in range(int(rng.integers(1, 3)))
            )
        parts, z = [], 0.0
        for _ in range(int(rng.integers(1, 4))):
            x, y, h = rng.uniform(0.5, 1.3), rng.uniform(0.5, 1.1), rng.uniform(0.3, 0.9)
            turn = (0.0, 0.0, float(rng.normal(0, 0.15)))
            place = (float(rng.uniform(-0.1, 0.1)), float(rng.uniform(-0.1, 0.1)), z + h / 2)
            parts.append(Part(Box((x, y, h)), p.choose("crate"), place, turn))
            z += h
        return tuple(parts)

    def load(self) -> Model:
        """A crate on a hook and a cable."""
        p = self.palette
        return (
            Part(Box((1.0, 0.7, 0.6)), p.choose("crate"), (0.0, 0.0, 0.3)),
            Part(Cylinder(0.3, 0.35, 0.02, 4), p.choose("metal"), (0.0, 0.0, 0.8)),
            Part(Cylinder(0.012, 1.0, None, 4), p.choose("metal"), (0.0, 0.0, 1.4)),
        )

    def flying_machine(self) -> Model:
        """Another drone: a body with four arms and rotors."""
        p = self.palette
        arms = [
            Part(Cylinder(0.2, 0.03, None, 8), p.choose("metal"), (x, y, 0.22))
            for x in (-0.4, 0.4)
            for y in (-0.4, 0.4)
        ]
        return (
            Part(Box((0.5, 0.4, 0.22)), p.choose("machine"), (0.0, 0.0, 0.11)),
            Part(Box((1.1, 0.08, 0.05)), p.choose("metal"), (0.0, 0.0, 0.19), (0.0, 0.0, 0.785)),
            Part(Box((1.1, 0.08, 0.05)), p.choose("metal"), (0.0, 0.0, 0.18), (0.0, 0.0, -0.785)),
            *arms,
        )

    def _shell(self) -> None:
        """Floor and walls, with doors, windows, columns and marks on the floor."""
        rng, p, (lx, ly, lz) = self._rng, self.palette, self._size
        out = 60.0 if self._outdoors else 0.0
        self._put(Panel(lx + out, ly + out), p.choose("floor"), (0, 0, 0), shadow=False)
        for k in range(10):
            x, y = rng.uniform(-0.5, 0.5, 2) * self._size[:2]
            mark = Panel(rng.uniform(2, 8), 0.12) if k < 6 else Panel(rng.uniform(0.5, 2), rng.uniform(0.5, 2))
            material = p.choose("sign" if k < 6 else "stone")
            self._put(mark, material, (x, y, 0.002 + 0.0005 * k), yaw=np.pi / 2 * (k % 2), shadow=False)
        lit = int(rng.integers(4))
        for k, (long, away) in enumerate(((lx, ly / 2), (ly, lx / 2), (lx, ly / 2), (ly, lx / 2))):
            yaw = k * np.pi / 2
            high = lz if not self._outdoors else lz * rng.uniform(0.5, 1.5)
            wall = p.choose("facade" if self._outdoors else "wall")
            # Where the light comes from, no wall is in its way; the others shade corners.
            self._put(
                Box((long + 0.4, 0.4, high)), wall, (0, away + 0.2, high / 2), yaw, shadow=self._outdoors and k != lit
            )
            self._put(Box((long, 0.1, 1.1)), p.choose("stone"), (0, away - 0.01, 0.55), yaw, shadow=False)
            for x in np.arange(-long / 2 + 1.0, long / 2, rng.uniform(3.5, 6.0)):
                column = Box((0.35, 0.3, high))
                self._put(column, p.choose("metal"), (float(x), away - 0.12, high / 2), yaw)
                if rng.random() < 0.6:
                    window = (rng.uniform(1.2, 2.2), 0.1, rng.uniform(0.9, 2.0))
                    z = rng.uniform(0.4, 0.75) * high
                    self._put(Box(window), p.choose("facade"), (float(x) + 1.8, away, z), yaw, shadow=False)
            door = Box((rng.uniform(1.2, 3.5), 0.14, rng.uniform(2.1, 3.5)))
            self._put(
                door, p.choose("wood"), (rng.uniform(-0.3, 0.3) * long, away, door.size[2] / 2), yaw, shadow=False
            )

    def _ceiling(self) -> None:
        """The ceiling with beams, lamps, ducts and pipes below it."""
        rng, p, (lx, ly, lz) = self._rng, self.palette, self._size
        self._put(Box((lx, ly, 0.2)), p.choose("wall"), (0, 0, lz + 0.1), shadow=False)
        for x in np.arange(-lx / 2 + 1.5, lx / 2, rng.uniform(2.5, 4.0)):
            self._put(Box((0.2, ly, 0.4)), p.choose("metal"), (float(x), 0, lz - 0.2))
            for y in np.arange(-ly / 2 + 1.5, ly / 2, 3.5):
                self._put(Box((0.25, 1.3, 0.12)), p.choose("lamp"), (float(x) + 0.9, float(y), lz - 0.5), shadow=False)
        for _ in range(int(rng.integers(4, 9))):
            radius, along = rng.uniform(0.05, 0.3), rng.random() < 0.5
            long, wide = (lx, ly) if along else (ly, lx)
            offset = rng.uniform(-0.45, 0.45) * wide
            place = (0.0, offset, lz - 0.45 - radius)
            yaw = 0.0 if along else np.pi / 2
            self._put(Cylinder(radius, long, None, 10), p.choose("metal"), place, yaw, lying=True)

    def _try_floor(self, maker: Callable[[], Model]) -> None:
        """Puts a thing on the floor, mostly along the walls, if it is off the way."""
        model = maker()
        for _ in range(4):
            at = self._rng.uniform(-0.5, 0.5, 2)
            if self._rng.random() < 0.4:
                axis = int(self._rng.integers(2))
                at[axis] = np.sign(at[axis]) * 0.5
            yaw = float(self._rng.integers(4) * np.pi / 2 + self._rng.normal(0, 0.1))
            low, high = bounds(model, yaw)
            place = np.append(
                np.clip(at * self._size[:2], -self._size[:2] / 2 - low[:2], self._size[:2] / 2 - high[:2]), 0
            )
            if self._claim(low + place, high + place):
                self.bodies += stand(model, _pose(place, yaw))
                return

    def _try_wall(self) -> None:
        """Hangs a poster, a box, a pipe or a clock on a wall."""
        rng, p = self._rng, self.palette
        k = int(rng.integers(4))
        long, away = (self._size[0], self._size[1] / 2) if k % 2 == 0 else (self._size[1], self._size[0] / 2)
        x, z = rng.uniform(-0.48, 0.48) * long, rng.uniform(0.15, 0.95) * min(self._size[2], 6.0)
        style = rng.random()
        if style < 0.5:
            w, h = rng.uniform(0.5, 1.8), rng.uniform(0.4, 1.4)
            self._put(Box((w, 0.05, h)), p.choose("poster"), (x, away - 0.03 - rng.uniform(0, 0.1), z), k * np.pi / 2)
        elif style < 0.75:
            deep = rng.uniform(0.1, 0.3)
            box = Box((rng.uniform(0.3, 0.9), deep, rng.uniform(0.3, 1.1)))
            self._put(box, p.choose("machine"), (x, away - deep / 2, z), k * np.pi / 2)
        else:
            radius = rng.uniform(0.03, 0.14)
            lying = rng.random() < 0.5
            pipe = Cylinder(radius, rng.uniform(2, 7), None, 8)
            high = z if lying else 2.5
            self._put(pipe, p.choose("metal"), (0.6 * x, away - 0.2 - radius, high), k * np.pi / 2, lying=lying)

    def _try_air(self) -> None:
        """A load on a crane's hook, a lamp or a sign that hangs from above, or a walkway."""
        rng, p = self._rng, self.palette
        x, y = (rng.uniform(-0.42, 0.42, 2) * self._size[:2]).tolist()
        z, top = rng.uniform(0.3, 0.85) * self._size[2], self._size[2]
        style = rng.random()
        if style < 0.35:
            piece = Part(Box(tuple(rng.uniform(0.4, 1.4, 3).tolist())), p.choose("crate"), (0.0, 0.0, 0.0))
        elif style < 0.7:
            piece = Part(Box((rng.uniform(0.8, 2.0), 0.05, rng.uniform(0.4, 0.9))), p.choose("poster"))
        else:
            piece = Part(Cylinder(0.3, 0.35, 0.1, 10), p.choose("metal"))
        cable = Part(Cylinder(0.015, top - z, None, 4), p.choose("metal"), (0.0, 0.0, (top - z) / 2))
        model, yaw = (piece, cable), float(rng.uniform(0, np.pi))
        low, high = bounds(model, yaw)
        place = np.array([x, y, z])
        if self._claim(low + place, high + place):
            self.bodies += stand(model, _pose(place, yaw))

    def _claim(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Takes an upright box if it is off the camera's way and nothing else is in it."""
        outside = np.maximum(np.maximum(low - self._way, self._way - high), 0.0)
        if np.linalg.norm(outside, axis=1).min() < self._clearance:
            return False
        boxes = self._boxes
        if ((boxes[:, 0] < high) & (boxes[:, 1] > low)).all(axis=1).any():
            return False
        self._boxes = np.concatenate([boxes, np.stack([low, high])[None]])
        return True

    def _put(
        self,
        shape: Box | Cylinder | Panel,
        material: int,
        place: tuple[float, float, float],
        yaw: float = 0.0,
        *,
        lying: bool = False,
        shadow: bool = True,
    ) -> None:
        """A body at a place that turns with it about the origin; lying: its axis along x."""
        turn = Rotation.from_euler("z", yaw)
        rotation = turn * Rotation.from_euler("y", np.pi / 2) if lying else turn
        at, rotvec = turn.apply(place).tolist(), rotation.as_rotvec().tolist()
        self.bodies.append(Body(shape, material, tuple(at), tuple(rotvec), shadow=shadow))


def _flight(rng: np.random.Generator, wish: Wish, size: np.ndarray, clearance: float) -> Path:
    """The camera's path but for the shaking, off the walls, the floor and what hangs under the ceiling."""
    half = np.minimum(size[:2] / 2 - clearance - 0.9, rng.uniform(3.0, 7.0))
    low, high = 0.35 + clearance, size[2] - 1.2 - clearance
    middle = rng.uniform(-1, 1, 2) * (size[:2] / 2 - clearance - 0.9 - half)
    centre = (float(middle[0]), float(middle[1]), float(0.5 * (low + high)))
    box = random_motions.FreeSpace(centre, (float(half[0]), float(half[1]), float(0.5 * (high - low))))
    if wish.motion == "rest":
        pose = random_motions.drone(rng, 4.0, box).poses(2.0)
        return at_rest(pose, wish.duration)
    if wish.motion == "rotation":
        return random_motions.pure_rotation(rng, wish.duration, centre)
    if wish.motion == "loop":
        return random_motions.closed_loop(rng, wish.duration, box)
    if wish.motion == "shaken":
        # At a third of the speed, so that the shaking is most of the flow.
        inner = random_motions.FreeSpace(box.centre, (box.half[0] - _SHAKE, box.half[1] - _SHAKE, box.half[2] - _SHAKE))
        return slowed(random_motions.drone(rng, wish.duration / 3, inner), wish.duration)
    if wish.motion == "stops":
        ease = min(1.5, wish.duration / 6)
        return with_stops(random_motions.drone(rng, max(wish.duration - 1.0 - ease, 3 * ease), box), rng, 1, ease)
    return random_motions.drone(rng, wish.duration, box)


def _pose(place: np.ndarray, yaw: float) -> np.ndarray:
    return rigid_motion(Rotation.from_euler("z", yaw).as_matrix(), place)

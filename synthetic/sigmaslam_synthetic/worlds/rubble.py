"""What is left of a house: planks, nets and rubble close around a camera that is carried or flies through."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.motion.random_motions import FreeSpace, pure_rotation
from sigmaslam_synthetic.motion.shaken import shaken
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Panel, Sheet
from sigmaslam_synthetic.scene import Body, Scene
from sigmaslam_synthetic.worlds.episode import Episode, Wish, carried, daylight
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, Part, bounds, centred, follow, stand
from sigmaslam_synthetic.worlds.street_furniture import person

CLEARANCE = 0.6
"""Metres between the camera and any surface that does not move, at least."""

_FREE_FOR_MOVERS = 0.5  # more of it where bodies move about in front of the camera
_SHAKE = 0.05  # metres that a shaken camera leaves its way
_EYES = 1.5  # its height, metres
_NEAREST, _FARTHEST = 1.1, 4.0  # metres from the way to the middles of what stands about
_THINGS = 46
_NETS = 4


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """Heaps, leaning planks, posts and nets 1-4 m around a short way, between the walls of houses that stand."""
    way = _way(rng, wish)
    path = shaken(rng, way, _SHAKE) if wish.motion == "shaken" else way
    site = _Site(rng, Palette(rng, wish, "rubble"), path, CLEARANCE + _FREE_FOR_MOVERS * (wish.movers > 0))
    site.build()
    bodies = site.bodies
    if wish.movers > 0:
        makers = (site.swinging_plank, lambda: person(rng, site.palette), site.heap)
        models = [makers[int(rng.integers(3))]() for _ in range(1 + int(wish.movers > 0.15))]
        share = min(1.3 * wish.movers, 0.55)  # some of it will be behind what rests
        bodies += follow(rng, way, wish.duration, share, [centred(model) for model in models], (0.6, 1.3))
    # Hazy: the sun is as strong as the sky, and shadows are not black.
    lights = replace(daylight(rng, 30, (0.3, 0.6)), ambient=float(rng.uniform(0.35, 0.5)))
    return Episode(Scene(tuple(bodies), tuple(site.palette.materials), lights, sky=float(rng.uniform(0.6, 1.0))), path)


class _Site:
    """What lies about so far.

    Args:
        path: of the camera.
        clearance: metres around the path that stay free.

    Attributes:
        bodies: what was built so far.
    """

    def __init__(self, rng: np.random.Generator, palette: Palette, path: Path, clearance: float) -> None:
        self.bodies: list[Body] = []
        self.palette = palette
        self._rng, self._clearance = rng, clearance
        self._way = path.poses(np.linspace(0.0, path.end, int(path.end / 0.05) + 2))[:, :3, 3]

    def build(self) -> None:
        """Builds all of it."""
        self._ground()
        self._walls()
        for _ in range(_NETS):
            self._try(self.net)
        makers: tuple[Callable[[], Model], ...] = (self.planks, self.heap, self.heap, self.frame)
        for k in range(_THINGS):
            self._try(makers[k % len(makers)])

    def net(self) -> Model:
        """A net of cords between two posts: the same mesh over and over."""
        rng, p = self._rng, self.palette
        wide, high, mesh = rng.uniform(1.4, 2.6), rng.uniform(1.6, 2.4), rng.uniform(0.08, 0.14)
        cord, thick = p.choose("cord"), rng.uniform(0.012, 0.02)
        parts = [
            Part(Box((0.08, 0.08, high + 0.2)), p.choose("wood"), (x, 0.0, high / 2)) for x in (-wide / 2, wide / 2)
        ]
        across, upright = (0.5 * np.pi, 0.0, 0.0), (0.0, 0.0, 0.0)
        for x in np.arange(-wide / 2 + mesh, wide / 2, mesh).tolist():
            parts.append(Part(Panel(thick, high - 0.2), cord, (x, 0.0, high / 2 + 0.1), across))
        for z in np.arange(0.2, high, mesh).tolist():
            parts.append(Part(Panel(wide, thick), cord, (0.0, 0.004, z), across))
        return (*parts, Part(Box((wide, 0.05, 0.05)), p.choose("wood"), (0.0, 0.0, high), upright))

    def planks(self) -> Model:
        """Planks that lean against a trestle, each as it fell."""
        rng, p = self._rng, self.palette
        high = rng.uniform(0.7, 1.7)
        parts = [Part(Box((1.2, 0.09, 0.09)), p.choose("wood"), (0.0, 0.0, high))]
        parts += [Part(Box((0.09, 0.09, high)), p.choose("wood"), (x, 0.0, high / 2)) for x in (-0.5, 0.5)]
        for _ in range(int(rng.integers(3, 7))):
            long, lean = high + rng.uniform(0.4, 1.4), rng.uniform(0.3, 0.6) * rng.choice([-1.0, 1.0])
            turn = Rotation.from_euler("xy", [lean, rng.normal(0.0, 0.15)])
            board = Box((rng.uniform(0.1, 0.24), rng.uniform(0.02, 0.05), long))
            place = (float(rng.uniform(-0.55, 0.55)), float(np.sign(lean) * 0.1), float(0.5 * long * np.cos(lean)))
            x, y, z = turn.as_rotvec().tolist()
            parts.append(Part(board, p.choose("wood"), place, (x, y, z)))
        return tuple(parts)

    def heap(self) -> Model:
        """Broken stones, slabs and bricks as they came to lie, the larger ones below."""
        rng, p = self._rng, self.palette
        high, wide = rng.uniform(0.3, 1.1), rng.uniform(0.5, 1.0)
        parts = []
        for _ in range(int(rng.integers(14, 30))):
            up = rng.uniform(0.0, 1.0) ** 1.5
            away, around = (1.0 - up) * wide * rng.uniform(0.0, 1.0) ** 0.5, rng.uniform(0.0, 2 * np.pi)
            size = (0.12 + 0.25 * (1.0 - up)) * rng.uniform((0.6, 0.5, 0.25), (1.7, 1.2, 0.9))
            x, y, z = Rotation.random(random_state=rng).as_rotvec().tolist()
            place = (float(away * np.cos(around)), float(away * np.sin(around)), float(up * high + 0.05))
            stone = Box((float(size[0]), float(size[1]), float(size[2])))
            parts.append(Part(stone, p.choose("stone" if rng.random() < 0.7 else "brick"), place, (x, y, z)))
        for _ in range(int(rng.integers(0, 4))):  # bars of the concrete
            turn = Rotation.from_euler("xyz", rng.normal(0.0, 0.7, 3)).as_rotvec().tolist()
            bar = Cylinder(rng.uniform(0.01, 0.02), rng.uniform(0.5, 1.2), None, 5)
            parts.append(Part(bar, p.choose("metal"), (0.0, 0.0, high), (turn[0], turn[1], turn[2])))
        return tuple(parts)

    def frame(self) -> Model:
        """What is left of a wall: posts with a rail, a board or two and a piece of masonry."""
        rng, p = self._rng, self.palette
        wide, high = rng.uniform(0.9, 1.6), rng.uniform(1.6, 2.8)
        parts = [Part(Box((0.1, 0.1, high)), p.choose("wood"), (x, 0.0, high / 2)) for x in (-wide / 2, wide / 2)]
        for z in (rng.uniform(0.3, 1.0), rng.uniform(1.1, high)):
            turn = (0.0, float(rng.normal(0.0, 0.12)), 0.0)
            parts.append(Part(Box((1.1 * wide, 0.03, rng.uniform(0.1, 0.3))), p.choose("wood"), (0.0, -0.07, z), turn))
        low = rng.uniform(0.2, 0.8)
        parts.append(Part(Box((0.7 * wide, 0.2, low)), p.choose("brick"), (0.1 * wide, 0.18, low / 2)))
        return tuple(parts)

    def swinging_plank(self) -> Model:
        """Two planks that are nailed together, as they hang from a hook."""
        p = self.palette
        return (
            Part(Box((1.5, 0.04, 0.2)), p.choose("wood"), (0.0, 0.0, 0.5)),
            Part(Box((0.2, 0.05, 1.0)), p.choose("wood"), (0.2, 0.05, 0.5)),
        )

    def _ground(self) -> None:
        seed = int(self._rng.integers(2**31))
        self.bodies.append(Body(Sheet((26.0, 26.0), 0.12, 1.1, seed, 60), self.palette.choose("ground"), shadow=False))

    def _walls(self) -> None:
        """Four walls of houses, some of them broken down."""
        rng = self._rng
        for k in range(4):
            turn = Rotation.from_euler("z", 0.5 * np.pi * k)
            x, away = -9.0, rng.uniform(5.5, 8.5)
            while x < 9.0:
                wide, high = rng.uniform(1.5, 4.0), rng.uniform(1.0, 6.0)
                place = turn.apply([x + wide / 2, away + 0.2, high / 2]).tolist()
                wall = Box((wide, rng.uniform(0.3, 0.6), high))
                rotation = turn.as_rotvec().tolist()
                self.bodies.append(Body(wall, self.palette.choose("wall"), tuple(place), tuple(rotation)))
                x += wide

    def _try(self, maker: Callable[[], Model]) -> None:
        """Puts a thing beside the way, if it is off it; things may lie on each other."""
        model = maker()
        for _ in range(6):
            beside = self._way[int(self._rng.integers(len(self._way))), :2]
            away, around = self._rng.uniform(_NEAREST, _FARTHEST), self._rng.uniform(0.0, 2 * np.pi)
            # It shows its broad side, more or less.
            yaw = float(around + 0.5 * np.pi + self._rng.normal(0.0, 0.4))
            low, high = bounds(model, yaw)
            place = np.append(beside + away * np.array([np.cos(around), np.sin(around)]), 0.0)
            outside = np.maximum(np.maximum(low + place - self._way, self._way - high - place), 0.0)
            if np.linalg.norm(outside, axis=1).min() >= self._clearance:
                self.bodies += stand(model, rigid_motion(Rotation.from_euler("z", yaw).as_matrix(), place))
                return


def _way(rng: np.random.Generator, wish: Wish) -> Path:
    """The camera's path but for the shaking."""
    free = FreeSpace((0.0, 0.0, _EYES), (1.2, 0.9, 0.25))
    if wish.motion == "rotation":
        return pure_rotation(rng, wish.duration, free.centre)
    return carried(rng, wish, free)

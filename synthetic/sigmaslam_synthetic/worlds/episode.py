"""A world with a way through it: what every generator makes."""

from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from sigmaslam_synthetic.motion.paths import Path, at_rest, with_stops
from sigmaslam_synthetic.motion.random_motions import FreeSpace, closed_loop, hand_held
from sigmaslam_synthetic.motion.shaken import slowed
from sigmaslam_synthetic.scene import Lights, Scene, Texture


@dataclass(frozen=True, slots=True)
class Episode:
    """A scene and the camera's path through it.

    Attributes:
        scene: all there is to see.
        path: of the left camera, axes x right, y down, z forward; it lasts from 0 to the duration asked for, or longer.
    """

    scene: Scene
    path: Path


@dataclass(frozen=True, slots=True)
class Wish:
    """What a generator is asked for.

    Attributes:
        duration: seconds.
        motion: one of `MOTIONS`: the domain's own way of moving, with stops, turning on the spot, coming back to the
            start (for loop closure), at rest, shaken, which the worlds of `CARRIED` presets alone know, or planar, on a
            robot with wheels, in those of `ROLLING`.
        movers: share of the image that independently moving bodies cover about, 0 to 0.5.
        profile: KITTI poses file whose motion a drive follows; none: random.
        first_texture, textures: range of the textures' seeds, so that many worlds can share a bank of them.
    """

    duration: float
    motion: str = "normal"
    movers: float = 0.0
    profile: FilePath | None = None
    first_texture: int = 0
    textures: int = 4

    def texture(self, rng: np.random.Generator, kind: str, tile: float, contrast: float = 1.0) -> Texture:
        """A texture of that kind out of the bank."""
        return Texture(kind, self.first_texture + int(rng.integers(self.textures)), tile, contrast)


def daylight(rng: np.random.Generator, lowest: float, sun: tuple[float, float]) -> Lights:
    """The sun from anywhere between `lowest` and 70 degrees above the horizon, of a strength in that range."""
    elevation, azimuth = np.deg2rad(rng.uniform(lowest, 70)), rng.uniform(0, 2 * np.pi)
    x, y = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)
    direction = float(x), float(y), float(np.sin(elevation))
    return Lights(ambient=float(rng.uniform(0.2, 0.4)), sun=float(rng.uniform(*sun)), sun_direction=direction)


def carried(rng: np.random.Generator, wish: Wish, free: FreeSpace, shake: float = 0.0) -> Path:
    """The path of a camera in a hand, but for the shaking; `wish.motion` is neither on the spot nor planar.

    Args:
        free: where the camera may be.
        shake: metres by which a slow path that is to be shaken keeps off its borders.
    """
    duration = wish.duration
    if wish.motion == "loop":
        return closed_loop(rng, duration, free)
    if wish.motion == "rest":
        return at_rest(hand_held(rng, duration, free).poses(0.5 * duration), duration)
    if wish.motion == "shaken":
        x, y, z = free.half
        inner = FreeSpace(free.centre, (x - shake, y - shake, z - shake))
        return slowed(hand_held(rng, 0.5 * duration, inner), duration)
    if wish.motion == "stops":
        moving = 0.75 * duration
        return with_stops(hand_held(rng, moving, free), rng, 1 + int(duration / 8), min(1.0, 0.5 * moving))
    return hand_held(rng, duration, free)

"""A drive through a town, as KITTI's car sees it: the way comes first, the town is laid out along it."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sigmaslam_synthetic.motion import random_motions
from sigmaslam_synthetic.motion.paths import Path, at_rest, with_stops
from sigmaslam_synthetic.motion.random_motions import CAMERA_HEIGHT
from sigmaslam_synthetic.scene import Scene
from sigmaslam_synthetic.worlds.episode import Episode, Wish, daylight
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.street_layout import Street
from sigmaslam_synthetic.worlds.street_road import Road
from sigmaslam_synthetic.worlds.street_traffic import add_traffic

_SHORTEST = 12.0  # seconds of drive along which a street is laid out


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A street with houses, trees and cars along a drive; the camera is 1.65 m above the ground."""
    path, way = _drive(rng, wish)
    opposite = float(rng.uniform(3.1, 3.6)) if rng.random() < 0.75 or wish.movers > 0 else 0.0
    road = Road(rng, way, wish.motion == "loop", opposite)
    path = _grounded(path, road)
    palette = Palette(rng, wish, "street")
    street = Street(rng, road, palette)
    if wish.motion == "rotation" and wish.movers > 0:
        street.clear(path.positions[0, :2], 7.0)  # what moves with the view goes round
    street.build()
    bodies = street.bodies + add_traffic(rng, wish, path, road, palette)
    lights = daylight(rng, 20, (0.7, 1.3))
    scene = Scene(tuple(bodies), tuple(palette.materials), lights, sky=float(rng.uniform(0.8, 2.2)))
    return Episode(scene, path)


def _drive(rng: np.random.Generator, wish: Wish) -> tuple[Path, np.ndarray]:
    """The camera's path, and places (N, 3) along the lane that it is on."""
    stay = wish.motion in ("rest", "rotation")
    duration = min(wish.duration, _SHORTEST) if stay and wish.profile else max(wish.duration, _SHORTEST * stay)
    ease = min(4.0, duration / 5)
    stops = 1 + int(duration > 25)
    if wish.motion == "stops":
        duration = max(duration - 0.5 * ease - 1.0, 1.0)
    if wish.motion == "loop":
        size = max(8.0 * duration / 5.4, 20.0)
        box = random_motions.FreeSpace(
            (0.0, 0.0, CAMERA_HEIGHT), (size * rng.uniform(0.8, 1.0), size * 0.9, 0.01 * size)
        )
        path = random_motions.closed_loop(rng, duration, box)
    elif wish.profile is not None:
        path = random_motions.drive_profile(wish.profile, duration, rng)
    else:
        path = random_motions.drive(rng, duration)
    times = np.linspace(0.0, path.end, max(20, int(path.end / 0.05)))
    way = path.poses(times)[:, :3, 3]
    if stay:
        pose = path.poses(0.5 * path.end)
        x, y, z = pose[:3, 3].tolist()
        still = wish.motion == "rest"
        path = at_rest(pose, wish.duration) if still else random_motions.pure_rotation(rng, wish.duration, (x, y, z))
    elif wish.motion == "stops" and not path.stops:
        path = with_stops(path, rng, stops, ease)
    return path, way


def _grounded(path: Path, road: Road) -> Path:
    """The same path above the ground as it is: where a drive crosses itself, the two heights are made one."""
    positions = path.positions.copy()
    height = positions[:, 2] - CAMERA_HEIGHT
    # What the springs do stays; what the ground does is the ground's.
    seconds = max(len(positions) * 1.5 / max(path.end, 1.5), 1e-3)
    bounce = height - gaussian_filter1d(height, seconds, mode="reflect")
    positions[:, 2] = road.smooth_ground(positions[:, :2]) + CAMERA_HEIGHT + np.clip(bounce, -0.04, 0.04)
    return replace(path, positions=positions)

"""A drive through a town, as KITTI's car sees it: the way comes first, the town is laid out along it."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sigmaslam_synthetic.motion import random_motions
from sigmaslam_synthetic.motion.paths import Path, at_rest, with_stops
from sigmaslam_synthetic.scene import Scene
from sigmaslam_synthetic.worlds.episode import Episode, Wish, daylight
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.street_layout import Street
from sigmaslam_synthetic.worlds.street_road import CAMERA_HEIGHT, Road
from sigmaslam_synthetic.worlds.street_traffic import add_traffic

_SHORTEST = 12.0  # seconds of drive along which a street is laid out
_TEXTURES = {"facade": 3, "leaves": 2, "asphalt": 1, "grass": 1, "bricks": 2, "cells": 1, "glyphs": 1, "wood": 1,
             "noise": 1, "strokes": 1}  # fmt: skip


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A street with houses, trees and cars along a drive; the camera is 1.65 m above the ground."""
    path, way = _drive(rng, wish)
    opposite = float(rng.uniform(3.1, 3.6)) if rng.random() < 0.75 or wish.movers > 0 else 0.0
    road = Road(rng, way, wish.motion == "loop", opposite)
    path = _grounded(path, road)
    palette = _palette(rng, wish)
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
        duration -= 0.5 * ease + 1.0
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
    bounce = height - _smooth(height, seconds)
    positions[:, 2] = road.smooth_ground(positions[:, :2]) + CAMERA_HEIGHT + np.clip(bounce, -0.04, 0.04)
    return replace(path, positions=positions)


def _smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    return np.asarray(gaussian_filter1d(values, sigma, mode="reflect"))


def _palette(rng: np.random.Generator, wish: Wish) -> Palette:
    palette = Palette(rng, wish, _TEXTURES)
    add = palette.add
    add("road", (0.36, 0.55), ("asphalt", 4.5, 0.9), ("noise", 17.0, 0.3))
    add("land", (0.5, 0.62), ("grass", 4.0, 1.3), ("noise", 23.0, 0.4))
    add("pavement", (0.3, 0.6), ("bricks", 1.6, 0.8), ("asphalt", 6.0, 0.5), count=2)
    add("pavement", (0.35, 0.6), ("cells", 2.6, 0.7), ("asphalt", 4.0, 0.5))
    add("pavement", (0.4, 0.6), ("asphalt", 2.5, 0.9))
    add("yard", (0.5, 0.65), ("grass", 2.5, 1.5), ("strokes", 3.0, 0.6), count=2)
    add("yard", (0.4, 0.6), ("cells", 3.1, 0.6), ("noise", 9.0, 0.5))
    add("mark", (0.75, 0.95), ("asphalt", 2.0, 1.0))
    add("patch", (0.2, 0.6), ("asphalt", 2.2, 1.3), count=3)
    add("facade", (0.27, 0.55), ("facade", 10.5, 1.2), ("noise", 7.0, 0.4), count=6)
    add("facade", (0.35, 0.65), ("facade", 6.5, 1.1), ("bricks", 1.9, 0.5), count=3)
    add("facade", (0.3, 0.6), ("facade", 15.0, 1.2), ("asphalt", 4.0, 0.6), count=3)
    add("masonry", (0.25, 0.6), ("bricks", 1.9, 1.1), ("noise", 5.0, 0.5), count=3)
    add("roof", (0.15, 0.4), ("bricks", 4.5, 1.0), ("noise", 9.0, 0.5), count=3)
    add("stone", (0.5, 0.8), ("asphalt", 3.0, 1.0), ("noise", 5.0, 0.4), count=3)
    add("leaves", (0.25, 0.45), ("strokes", 1.3, 1.6), ("leaves", 1.1, 0.7), count=3)
    add("leaves", (0.42, 0.58), ("grass", 1.6, 1.7), ("leaves", 0.9, 0.6), count=3)
    add("bark", (0.2, 0.4), ("wood", 0.8, 1.3), ("grass", 0.8, 0.8), count=2)
    add("wood", (0.25, 0.6), ("wood", 1.5, 1.3), count=3)
    add("door", (0.15, 0.7), ("wood", 1.8, 1.2), ("noise", 4.0, 0.3), count=3)
    add("stripes", (0.4, 0.7), ("bricks", 3.0, 1.4), ("strokes", 4.0, 0.6), count=2)
    add("poster", (0.4, 0.6), ("leaves", 2.4, 1.0), ("glyphs", 1.4, 0.8), count=3)
    add("writing", (0.3, 0.65), ("glyphs", 1.3, 1.8), count=3)
    add("sign", (0.2, 0.7), ("glyphs", 1.0, 1.6), ("leaves", 1.2, 0.7), count=4)
    add("plate", (0.6, 0.9), ("glyphs", 0.8, 1.8), count=2)
    add("cargo", (0.2, 0.8), ("leaves", 4.0, 0.7), ("glyphs", 2.5, 0.9), count=3)
    add("paint", (0.2, 0.7), ("noise", 3.0, 0.4), ("leaves", 2.5, 0.1), count=6, specular=0.35)
    add("glass", (0.08, 0.2), ("leaves", 2.0, 0.3), count=2, specular=0.5)
    add("dark", (0.08, 0.22), ("noise", 2.0, 0.3), count=2)
    add("tyre", (0.06, 0.12), ("noise", 1.0, 0.2))
    add("lamp", (0.3, 0.9), ("cells", 0.6, 0.8), count=3)
    add("metal", (0.2, 0.65), ("noise", 1.5, 0.5), ("asphalt", 1.0, 0.5), count=3)
    add("cloth", (0.1, 0.7), ("strokes", 0.8, 0.7), ("leaves", 1.0, 0.5), count=4)
    add("skin", (0.35, 0.65), ("noise", 0.6, 0.4), count=2)
    return palette

"""A street with thin, curved, leafy and shining things in haze: `sigmaslam train render street --world`, and training.

It is the street of the preset with poles and wires along one side, fences of bars, trees of single leaves, and cars
with round bodies, glass and shining paint. In half of the streets one sees 0.15 to 3 kilometres.

    python examples/detailed_street.py street.png  # a picture of it
    sigmaslam train render street --out DIR --world examples/detailed_street.py
"""

import sys
from dataclasses import replace
from itertools import pairwise
from unittest.mock import patch

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion.random_motions import CAMERA_HEIGHT
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel
from sigmaslam_synthetic.scene import Body, Material, Texture
from sigmaslam_synthetic.simulation import Recipe, Studio, simulate
from sigmaslam_synthetic.worlds import street, street_layout, street_traffic
from sigmaslam_synthetic.worlds.episode import Episode, Wish
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, Part, stand

POLE_STEP, POLE_HEIGHT, WIRES = 18.0, 6.5, 3
"""Metres between poles, their height, and wires from one to the next."""
LEAVES = 260
"""Of a tree."""
_ASIDE = 5.6  # metres from the driven lane to what is added
_UPRIGHT = (float(np.pi / 2), 0.0, 0.0)  # turns a cylinder's axis from z to y


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """The street of the preset, whose cars are others, and what stands along it besides."""
    with patch.object(street_layout, "car", curved_car), patch.object(street_traffic, "car", curved_car):
        episode = street.generate(rng, wish)
    scene = episode.scene
    bark, leaf, wire, metal = (len(scene.materials) + k for k in range(4))
    materials = (
        Material(0.25, (wish.texture(rng, "wood", 0.8, 1.2),)),
        Material(0.45, (wish.texture(rng, "grass", 0.5, 1.2),)),
        Material(0.12, (wish.texture(rng, "noise", 0.5, 0.3),)),
        Material(0.5, (wish.texture(rng, "noise", 0.7, 0.5),), specular=0.6, gloss=60.0),
    )
    # Poses of the camera every metre, and beyond the drive's end.
    poses = episode.path.poses(np.linspace(0.0, episode.path.end, 50))
    last = poses[-1]
    ahead = last[:3, 2] * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead)
    way = np.concatenate([poses[:, :3, 3], last[:3, 3] + ahead * np.arange(1.0, 60.0)[:, None]])
    way[:, 2] -= CAMERA_HEIGHT
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1))])

    def place(s: float, left: float) -> np.ndarray:
        """T_world_thing (4, 4), x ahead, at s metres along the way."""
        here, there = (np.array([np.interp(at, arc, way[:, k]) for k in range(3)]) for at in (s, s + 0.5))
        yaw = np.arctan2(*(there - here)[1::-1]) if s + 0.5 < arc[-1] else np.arctan2(ahead[1], ahead[0])
        R = Rotation.from_euler("z", yaw).as_matrix()
        return rigid_motion(R, here + R @ [0.0, left, 0.0])

    hand = float(rng.choice([-1.0, 1.0]))
    bodies: list[Body] = []
    tops = [place(s, hand * _ASIDE) for s in np.arange(3.0, arc[-1], POLE_STEP)]
    for T in tops:
        bodies += stand((Part(Cylinder(0.08, POLE_HEIGHT, 0.05, 6), bark, (0.0, 0.0, POLE_HEIGHT / 2)),), T)
    for start, end in pairwise(tops):
        for k in range(WIRES):
            bodies += sagging_wire(start[:3, 3], end[:3, 3], POLE_HEIGHT - 0.25 - 0.3 * k, wire)
    for s in np.arange(6.0, arc[-1] - 8.0, 15.0):
        bodies += stand(fence(rng, 8.0, metal), place(s, -hand * (_ASIDE + rng.uniform(0.2, 1.0))))
    for s in np.arange(9.0, arc[-1], 17.0):
        bodies += stand(leafy_tree(rng, bark, leaf), place(s, -hand * (_ASIDE + 0.4)))
    lights = scene.lights
    if rng.random() < 0.5:
        lights = replace(lights, extinction=float(3.912 / np.exp(rng.uniform(*np.log([150.0, 3000.0])))))
    whole = replace(scene, bodies=scene.bodies + tuple(bodies), materials=scene.materials + materials, lights=lights)
    return Episode(whole, episode.path)


def curved_car(rng: np.random.Generator, palette: Palette) -> Model:
    """A car of ellipsoids on round wheels; paint and glass shine."""
    long, wide = rng.uniform(3.7, 4.7), rng.uniform(1.65, 1.85)
    paint, glass = (_shining(palette, palette.choose(name)) for name in ("paint", "glass"))
    dark, plate, lamp = (palette.choose(name) for name in ("dark", "plate", "lamp"))
    back = rng.uniform(-0.12, 0.0) * long
    wheels = [
        Part(Cylinder(0.31, wide - 0.05, None, 14), palette.choose("tyre"), (x * long, 0.0, 0.31), _UPRIGHT)
        for x in (-0.31, 0.31)
    ]
    return (
        Part(Ellipsoid((0.56 * long, 0.56 * wide, 0.42), 10), paint, (0.0, 0.0, 0.62)),
        Part(Box((0.8 * long, 0.92 * wide, 0.3)), paint, (0.0, 0.0, 0.5)),
        Part(Ellipsoid((0.33 * long, 0.43 * wide, 0.55), 10), glass, (back, 0.0, 0.95)),
        Part(Ellipsoid((0.22 * long, 0.36 * wide, 0.06), 8), paint, (back, 0.0, 1.46)),
        Part(Panel(0.5 * wide, 0.1), plate, (-0.53 * long, 0.0, 0.6), (0.0, float(np.pi / 2), 0.0)),
        *(Part(Ellipsoid((0.12, 0.16, 0.1), 5), lamp, (0.49 * long, y * wide, 0.66)) for y in (-0.32, 0.32)),
        *(Part(Ellipsoid((0.08, 0.1, 0.08), 4), dark, (0.12 * long, y * wide, 1.0)) for y in (-0.53, 0.53)),
        *wheels,
    )


def leafy_tree(rng: np.random.Generator, bark: int, leaf: int) -> Model:
    """A trunk, boughs, and single leaves between which one sees through."""
    trunk, radii = rng.uniform(1.8, 2.6), rng.uniform(1.0, 1.6, 3)
    parts = [Part(Cylinder(0.14, trunk + 1.0, 0.06, 6), bark, (0.0, 0.0, (trunk + 1.0) / 2))]
    for _ in range(5):
        tilt = tuple(rng.normal(0.0, 0.5, 3).tolist())
        parts.append(Part(Cylinder(0.03, 1.6, 0.01, 4), bark, (0.0, 0.0, trunk + 0.6), tilt))
    directions = rng.standard_normal((LEAVES, 3))
    directions *= rng.uniform(0.4, 1.0, (LEAVES, 1)) ** (1 / 3) / np.linalg.norm(directions, axis=1, keepdims=True)
    for x, y, z in (directions * radii + [0.0, 0.0, trunk + radii[2]]).tolist():
        turn = tuple(rng.uniform(-2.0, 2.0, 3).tolist())
        parts.append(Part(Panel(rng.uniform(0.06, 0.16), rng.uniform(0.05, 0.1)), leaf, (x, y, z), turn))
    return tuple(parts)


def fence(rng: np.random.Generator, long: float, metal: int) -> Model:
    """Bars and two rails along x."""
    high = rng.uniform(0.9, 1.4)
    bars = [Part(Box((0.02, 0.02, high)), metal, (x, 0.0, high / 2)) for x in np.arange(0.0, long, 0.14).tolist()]
    return (*bars, *(Part(Box((long, 0.03, 0.03)), metal, (long / 2, 0.0, z * high)) for z in (0.15, 0.92)))


def sagging_wire(start: np.ndarray, end: np.ndarray, height: float, material: int) -> list[Body]:
    """Four straight pieces from one pole's foot (3,) to the next one's, that far above."""
    share = np.linspace(0.0, 1.0, 5)[:, None]
    points = start + share * (end - start)
    points[:, 2] += height - 1.6 * (share * (1.0 - share))[:, 0]
    bodies = []
    for a, b in pairwise(points):
        along = b - a
        length = float(np.linalg.norm(along))
        turn, _ = Rotation.align_vectors(along[None] / length, [[0.0, 0.0, 1.0]])
        middle, rotation = tuple((0.5 * (a + b)).tolist()), tuple(turn.as_rotvec().tolist())
        bodies.append(Body(Cylinder(0.012, length, None, 4), material, middle, rotation, shadow=False))
    return bodies


def _shining(palette: Palette, chosen: int) -> int:
    """The material with sharper and stronger highlights, and less texture."""
    material = palette.materials[chosen]
    layers = tuple(Texture(each.kind, each.seed, each.tile, 0.5 * each.contrast) for each in material.layers)
    palette.materials.append(Material(material.brightness, layers, 1.0, 120.0))
    return len(palette.materials) - 1


def run(seed: int = 0) -> np.ndarray:
    """The first left image of the street of a seed, (H, W) uint8."""
    return Studio(simulate(Recipe("street", 1, seed, world=__file__))).frames(np.array([0]))[0].left


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    cv2.imwrite(sys.argv[1], run())

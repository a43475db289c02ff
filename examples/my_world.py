"""A world of one's own to train for and to render: small things on a bench, from 20 cm above.

    python examples/my_world.py bench.png  # a picture of it
    sigmaslam train --recipe fine-tune --world examples/my_world.py --worlds leaves --out my_features
    sigmaslam train render organ --world examples/my_world.py --out bench --frames 20

The program calls `generate` with a generator of random numbers and a wish, once for every scene. What it returns is a
scene, bodies of a few shapes with materials (`sigmaslam_synthetic.scene`, `.rendering.shapes`), and the camera's path
through it (`.motion.random_motions`). A texture is one of `sigmaslam_synthetic.rendering.textures.KINDS`, or the whole
path of a folder of photographs.
"""

import sys

import cv2
import numpy as np

from sigmaslam_synthetic.motion.random_motions import inspect
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Panel
from sigmaslam_synthetic.scene import Body, Lights, Material, Scene
from sigmaslam_synthetic.simulation import Recipe, Studio, simulate
from sigmaslam_synthetic.worlds.episode import Episode, Wish

DISTANCE = 0.2
"""Metres from the camera to the bench."""


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A bench with 15 - 30 boxes and tins under a lamp; nothing moves. World axes: z up; metres."""
    materials = [Material(0.5, (wish.texture(rng, "wood", 0.3),))]
    materials += [
        Material(float(rng.uniform(0.3, 0.7)), (wish.texture(rng, kind, 0.05),))
        for kind in ("glyphs", "checker", "strokes")
    ]
    bodies = [Body(Panel(1.0, 1.0), 0)]
    for _ in range(int(rng.integers(15, 31))):
        x, y = (float(v) for v in rng.uniform(-0.15, 0.15, 2))
        wide, deep, high = (float(v) for v in rng.uniform(0.01, 0.05, 3))
        shape = Box((wide, deep, high)) if rng.random() < 0.6 else Cylinder(0.5 * wide, high)
        turn = float(rng.uniform(-np.pi, np.pi))
        bodies.append(Body(shape, int(rng.integers(1, 4)), (x, y, high / 2), (0.0, 0.0, turn)))
    lights = Lights(ambient=0.4, sun=float(rng.uniform(0.3, 0.7)))
    path = inspect(rng, wish.duration, DISTANCE, 0.4 * DISTANCE)
    return Episode(Scene(tuple(bodies), tuple(materials), lights, near=0.02), path)


def run(seed: int = 0) -> np.ndarray:
    """The first left image of the world of a seed, by the camera of the preset organ, (H, W) uint8."""
    return Studio(simulate(Recipe("organ", 1, seed, world=__file__))).frames(np.array([0]))[0].left


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    cv2.imwrite(sys.argv[1], run())

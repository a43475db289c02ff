"""An instrument that is moved in front of a camera at rest: it is the thing to be tracked."""

from dataclasses import replace

import numpy as np

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion.paths import Path, at_rest, view_rotations
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Panel, Sheet
from sigmaslam_synthetic.scene import Body, Lights, Material, Scene
from sigmaslam_synthetic.worlds.episode import Episode, Wish
from sigmaslam_synthetic.worlds.tissue import NEAR, endoscope_light, instrument, lump, moved, placed, reaching, wet


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A richly textured instrument 60-200 mm in front of a camera that never moves, over tissue or a bench.

    `wish.motion` and `wish.movers` are the instrument's. Its bodies are all that have a path (`Scene.moving`); they
    come last, the shaft first of them, and keep rigid to each other.
    """
    surgical = rng.random() < 0.6
    distance = float(rng.uniform(0.1, 0.135))
    ground = float(rng.uniform(1.45, 1.7)) * distance
    R = view_rotations(rng.uniform(-np.pi, np.pi, 1), -rng.uniform(1.05, 1.45, 1), rng.uniform(-0.5, 0.5, 1))[0]
    # The view's axis meets the ground, z = 0, at the origin.
    T = rigid_motion(R, -ground * R[:, 2])
    bodies, materials, lights = (_tissue if surgical else _bench)(rng, wish, ground)
    around = rng.uniform(0, 2 * np.pi)
    port = 0.9 * distance * np.array([np.cos(around), np.sin(around), 0.6])
    target = np.array([0.0, 0.0, distance]) - 0.2 * port * [1.0, 1.0, 0.0]

    def make(seconds: float) -> Path:
        return placed(reaching(rng, seconds, port, target, 0.42 * distance, 0.012), T)

    path = moved(rng, wish, make, (0.08, 0.08, 0.3))
    camera, share = at_rest(T, wish.duration), wish.movers or float(rng.uniform(0.12, 0.3))
    thick = 0.03 * distance, 0.27 * distance
    tool_bodies, tool_materials = instrument(rng, wish, path, camera, thick, share, len(materials), rich=True)
    scene = Scene(tuple(bodies + tool_bodies), tuple(materials + tool_materials), lights, 0.0, NEAR)
    return Episode(scene, camera)


def _tissue(rng: np.random.Generator, wish: Wish, ground: float) -> tuple[list[Body], list[Material], Lights]:
    """Wet tissue in the light of an endoscope."""
    materials = [wet(rng, wish, (float(rng.uniform(0.06, 0.14)), float(rng.uniform(0.05, 0.12)))) for _ in range(2)]
    sheet = Sheet((0.8, 0.8), 0.05 * ground, float(rng.uniform(0.07, 0.12)), int(rng.integers(2**31)), 72)
    bodies = [Body(sheet, 0, (0.0, 0.0, -0.1 * ground))]
    for _ in range(int(rng.integers(2, 5))):
        x, y = (float(v) for v in rng.uniform(-0.6, 0.6, 2) * ground)
        along, across, up = (float(v) for v in rng.uniform((0.02, 0.02, 0.012), (0.05, 0.05, 0.02)))
        bodies.append(lump(rng, (along, across, up), (x, y, -0.12 * ground), 1, 14))
    # More scattered light than deep inside: the instrument is much nearer to the lamp than the tissue.
    return bodies, materials, replace(endoscope_light(rng, 0.6 * ground), ambient=float(rng.uniform(0.4, 0.8)))


def _bench(rng: np.random.Generator, wish: Wish, ground: float) -> tuple[list[Body], list[Material], Lights]:
    """A bench with small things, in the light of a room."""

    def material(kind: str, tile: float) -> Material:
        layers = (
            wish.texture(rng, kind, tile, float(rng.uniform(0.5, 1.1))),
            wish.texture(rng, "noise", 2 * tile, 0.4),
        )
        return Material(float(rng.uniform(0.25, 0.7)), layers)

    kinds = ("wood", "leaves", "strokes", "cells", "checker", "asphalt")
    materials = [material(kinds[int(rng.integers(len(kinds)))], float(rng.uniform(0.1, 0.4)))]
    materials += [material(kind, float(rng.uniform(0.04, 0.12))) for kind in ("leaves", "glyphs", "strokes")]
    bodies = [Body(Panel(0.8, 0.8), 0)]
    for _ in range(int(rng.integers(12, 24))):
        x, y = (float(v) for v in rng.uniform(-0.9, 0.9, 2) * ground)
        wide, long, tall = (float(v) for v in rng.uniform((0.012, 0.012, 0.003), (0.06, 0.06, 0.02)))
        shape = Box((wide, long, tall)) if rng.random() < 0.6 else Cylinder(0.5 * wide, tall, None, 20)
        bodies.append(Body(shape, 1 + int(rng.integers(3)), (x, y, tall / 2), (0.0, 0.0, float(rng.uniform(-3, 3)))))
    direction = float(rng.uniform(-0.8, 0.8)), float(rng.uniform(-0.8, 0.8)), 1.0
    return bodies, materials, Lights(float(rng.uniform(0.3, 0.5)), float(rng.uniform(0.4, 0.8)), direction)

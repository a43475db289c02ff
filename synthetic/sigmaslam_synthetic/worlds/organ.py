"""A laparoscope over organs."""

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.motion.random_motions import inspect
from sigmaslam_synthetic.rendering.shapes import Sheet
from sigmaslam_synthetic.scene import Body, Material, Scene
from sigmaslam_synthetic.worlds import tissue
from sigmaslam_synthetic.worlds.episode import Episode, Wish

_SIDE = 0.6  # metres of the sheet of tissue


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A bumpy sheet of tissue with organs and fat on it, 50-150 mm below a slanted laparoscope.

    A tool is in view in two of five worlds, and always where `wish.movers` is not 0; its bodies are all that moves.
    """
    height = float(rng.uniform(0.075, 0.115))
    highest = 0.35 * height  # of anything: the camera comes down to 0.75 of its height
    bumps = float(rng.uniform(0.06, 0.11)) * height
    sheet = Sheet((_SIDE, _SIDE), bumps, float(rng.uniform(0.04, 0.08)), int(rng.integers(2**31)), 72)
    materials = [
        tissue.wet(rng, wish, (float(rng.uniform(0.05, 0.11)), float(rng.uniform(0.03, 0.1)))) for _ in range(3)
    ]
    fat = wish.texture(rng, "noise", 0.04, 0.6), wish.texture(rng, "cells", 0.05, float(rng.uniform(0.1, 0.4)))
    materials.append(Material(0.65, fat, specular=1.5, gloss=150.0, bump=2.0))
    bodies = [Body(sheet, 0)]
    surface = sheet.facets().origin

    def lay(radii: np.ndarray, place: np.ndarray, material: int, rings: int) -> None:
        """An ellipsoid half sunk into the sheet, and nowhere too high."""
        ground = surface[int(np.argmin(((surface[:, :2] - place) ** 2).sum(axis=1))), 2]
        along, across, up = (float(r) for r in radii)
        z = min(highest - up, float(ground + rng.uniform(-0.6, -0.1) * up))
        bodies.append(tissue.lump(rng, (along, across, up), (float(place[0]), float(place[1]), z), material, rings))

    for _ in range(int(rng.integers(4, 9))):  # organs
        radii = rng.uniform((0.03, 0.02, 0.6 * highest), (0.09, 0.06, 1.4 * highest))
        lay(radii, rng.uniform(-0.15, 0.15, 2), int(rng.integers(3)), 14)
    for _ in range(int(rng.integers(1, 4))):  # fat, in lobules
        middle = rng.uniform(-0.09, 0.09, 2)
        for _ in range(int(rng.integers(4, 10))):
            radii = rng.uniform(0.006, 0.014) * np.append(rng.uniform(0.8, 1.6, 2), 1.0)
            lay(radii, middle + rng.normal(0, 0.014, 2), 3, 8)
    tilt = rigid_motion(Rotation.from_euler("x", rng.uniform(0.0, 0.3)).as_matrix(), np.zeros(3))

    def look(seconds: float) -> Path:
        return tissue.mounted(inspect(rng, seconds, height, 0.5 * height), tilt)

    path = tissue.moved(rng, wish, look, (0.1, 0.1, 0.3))
    if wish.movers > 0 or rng.random() < 0.4:
        tool_bodies, tool_materials = _tool(rng, wish, path, height, len(materials))
        bodies += tool_bodies
        materials += tool_materials
    return Episode(Scene(tuple(bodies), tuple(materials), tissue.endoscope_light(rng, height), 0.0, tissue.NEAR), path)


def _tool(
    rng: np.random.Generator, wish: Wish, path: Path, height: float, first: int
) -> tuple[list[Body], list[Material]]:
    """A tool through a port beside the camera, which follows it."""
    distance = float(rng.uniform(0.5, 0.6)) * height
    around = rng.uniform(0, 2 * np.pi)
    port = 0.7 * height * np.array([np.cos(around), np.sin(around), 0.25])
    target = np.array([0.0, 0.0, distance]) + 0.1 * port
    motion = tissue.carried(
        path, tissue.reaching(rng, wish.duration, port, target, 0.3 * distance, 0.004), wish.duration
    )
    share = wish.movers or float(rng.uniform(0.03, 0.1))
    return tissue.instrument(rng, wish, motion, path, (0.02 * height, 0.25 * height), share, first, rich=False)

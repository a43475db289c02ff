"""An endoscope in a bent, folded tube."""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from sigmaslam_synthetic.geometry import arc_length
from sigmaslam_synthetic.motion.paths import Path
from sigmaslam_synthetic.motion.random_motions import insertion
from sigmaslam_synthetic.rendering.shapes import Tube
from sigmaslam_synthetic.scene import Body, Material, Scene
from sigmaslam_synthetic.worlds import tissue
from sigmaslam_synthetic.worlds.episode import Episode, Wish

CLEARANCE = 0.004
"""Metres between the endoscope and the wall, at least."""

_KNOT = 0.05  # metres between points of the centreline
_AHEAD = 0.18  # metres of tube beyond the farthest place of the endoscope


def generate(rng: np.random.Generator, wish: Wish) -> Episode:
    """A colon of 20-40 mm radius with haustral folds; what is seen is mostly 15-150 mm away.

    A tool is in view in two of five worlds, and always where `wish.movers` is not 0; its bodies are all that moves.
    """
    radius = float(rng.uniform(0.02, 0.036))
    folds, bumps = float(rng.uniform(0.25, 0.4)) * radius, float(rng.uniform(0.02, 0.045)) * radius
    centreline = _centreline(rng, float(rng.uniform(0.2, 0.3)) + _AHEAD, radius)
    tube = Tube(
        tuple((float(x), float(y), float(z)) for x, y, z in centreline),
        radius,
        folds,
        float(rng.uniform(0.8, 1.4)) * radius,
        bumps,
        int(rng.integers(2**31)),
        rings=132,
        sides=56,
    )
    # Textures are mirrored: an even number of them round the tube leaves no seam.
    coarse, fine = np.pi * radius / rng.integers((1, 2), (3, 5))
    materials = [tissue.wet(rng, wish, (float(coarse), float(fine)))]
    bodies = [Body(tube, 0)]
    path = tissue.moved(rng, wish, lambda seconds: _insertion(rng, seconds, centreline, tube), turn=(0.15, 0.15, 0.4))
    if wish.movers > 0 or rng.random() < 0.4:
        tool_bodies, tool_materials = _tool(rng, wish, path, radius)
        bodies += tool_bodies
        materials += tool_materials
    # In a tube much light is scattered from wall to wall.
    lights = replace(tissue.endoscope_light(rng, 1.5 * radius), ambient=float(rng.uniform(0.1, 0.3)))
    return Episode(Scene(tuple(bodies), tuple(materials), lights, 0.0, tissue.NEAR), path)


def _centreline(rng: np.random.Generator, length: float, radius: float) -> np.ndarray:
    """Points (K, 3) of a curve whose bends are wider than the tube."""
    count = int(np.ceil(length / _KNOT))
    angles = np.cumsum(rng.normal(0.0, 0.35 * min(1.0, 0.025 / radius), (count, 2)), axis=0)
    step = np.stack([np.cos(angles[:, 0]), np.sin(angles[:, 0]), np.sin(angles[:, 1])], axis=-1)
    step *= _KNOT / np.linalg.norm(step, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])


def _insertion(rng: np.random.Generator, seconds: float, centreline: np.ndarray, tube: Tube) -> Path:
    arc = arc_length(centreline)
    way = CubicSpline(arc, centreline)(np.linspace(0.01, arc[-1] - _AHEAD, 40))
    free = tube.radius - tube.folds - 4 * tube.bumps - CLEARANCE
    return insertion(rng, seconds, way, 0.7 * free / 0.6)  # which stays within 0.6 of the radius that it is given


def _tool(rng: np.random.Generator, wish: Wish, path: Path, radius: float) -> tuple[list[Body], list[Material]]:
    """A tool out of the endoscope's working channel, which moves with it and on its own."""
    distance = float(rng.uniform(1.0, 1.4)) * radius
    around = rng.uniform(0, 2 * np.pi)
    port = 0.45 * radius * np.array([np.cos(around), np.sin(around), 0.0])
    target = 0.3 * port + np.array([0.0, 0.0, distance])
    motion = tissue.carried(
        path, tissue.reaching(rng, wish.duration, port, target, 0.3 * distance, 0.0005), wish.duration
    )
    share = wish.movers or float(rng.uniform(0.03, 0.12))
    return tissue.instrument(rng, wish, motion, path, (0.03 * radius, 0.22 * radius), share, 1, rich=False)

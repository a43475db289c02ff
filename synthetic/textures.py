"""Procedural textures: dead leaves whose leaves are themselves textured.

Sizes follow a power law (Lee, Mumford & Huang 2001), which gives the scale invariance and the occlusion edges of
natural images; what fills a leaf varies, because the diversity of the generator is what transfers.
"""

from __future__ import annotations

import cv2
import numpy as np

_SMALLEST_LEAF = 3.0


def dead_leaves(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A dead-leaves image with textured leaves.

    Args:
        shape: (height, width) in pixels.
        rng: source of all randomness; the same state gives the same image.
    Returns:
        (H, W) uint8.
    """
    height, width = shape
    canvas = _fill(shape, rng)
    largest = 0.35 * min(height, width)
    exponent = rng.uniform(1.1, 2.6)
    coverage = 0.0
    target = rng.uniform(1.5, 4.0) * height * width
    budget = int(rng.integers(200, 900))
    radii = _power_law(rng, budget, exponent, _SMALLEST_LEAF, largest)
    for radius in radii:
        _draw_leaf(canvas, radius, rng)
        coverage += np.pi * radius**2
        if coverage > target:
            break
    # Many small leaves on top keep corners everywhere, also where a large leaf fell last.
    for radius in _power_law(rng, int(rng.integers(50, 400)), 3.0, 2.0, 12.0):
        _draw_leaf(canvas, radius, rng)
    return np.clip(canvas, 0, 255).astype(np.uint8)


def noise_texture(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Fractal noise with a random spectral slope, (H, W) float32 of zero mean and unit standard deviation."""
    height, width = shape
    octaves = np.zeros(shape, np.float32)
    persistence = rng.uniform(0.4, 0.95)
    cells, amplitude = 2, 1.0
    while cells < max(shape):
        grid = rng.standard_normal((cells + 1, cells + 1)).astype(np.float32)
        octaves += amplitude * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, amplitude = cells * 2, amplitude * persistence
    return (octaves - octaves.mean()) / (octaves.std() + 1e-6)


def _power_law(rng: np.random.Generator, count: int, exponent: float, low: float, high: float) -> np.ndarray:
    """Radii with density r^-exponent on [low, high], by inversion."""
    power = 1.0 - exponent
    uniform = rng.random(count)
    return (low**power + uniform * (high**power - low**power)) ** (1.0 / power)


def _fill(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """What covers one leaf, (H, W) float32 in grey levels."""
    height, width = shape
    base, contrast = rng.uniform(10, 245), rng.uniform(0, 60) * rng.random()
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    kind = rng.integers(0, 7)
    if kind == 0 or min(shape) < 4:
        return np.full(shape, base, np.float32)
    if kind == 1:
        angle = rng.uniform(0, 2 * np.pi)
        ramp = (np.cos(angle) * u + np.sin(angle) * v) / max(height, width)
        return (base + 2.0 * contrast * ramp).astype(np.float32)
    if kind in (2, 3):
        return (base + contrast * noise_texture(shape, rng)).astype(np.float32)
    angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(4), np.log(40)))
    warp: float | np.ndarray = 0.0
    if rng.random() < 0.5:
        warp = rng.uniform(0.5, 3.0) * noise_texture(shape, rng)
    along = (np.cos(angle) * u + np.sin(angle) * v) / period + warp
    across = (-np.sin(angle) * u + np.cos(angle) * v) / period
    if kind == 4:
        return (base + contrast * np.sign(np.sin(2 * np.pi * along))).astype(np.float32)
    if kind == 5:
        return (base + contrast * np.sin(2 * np.pi * along)).astype(np.float32)
    # Bricks: every second row is shifted by half a brick; the mortar has the other grey.
    row = np.floor(along)
    brick = np.mod(across * 0.5 + 0.5 * np.mod(row, 2), 1.0)
    mortar = (np.mod(along, 1.0) < 0.12) | (brick < 0.06)
    shade = np.sin(12.9898 * row + 78.233 * np.floor(across * 0.5 + 0.5 * np.mod(row, 2)))
    return (base + contrast * (0.4 * shade - 1.5 * mortar)).astype(np.float32)


def _draw_leaf(canvas: np.ndarray, radius: float, rng: np.random.Generator) -> None:
    """Draws one leaf of a random shape at a random place into the canvas."""
    height, width = canvas.shape
    centre = np.array([rng.uniform(0, width), rng.uniform(0, height)])
    reach = int(np.ceil(1.6 * radius)) + 2
    left, top = np.floor(centre - reach).astype(int)
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + 2 * reach, width), min(top + 2 * reach, height)
    if x1 - x0 < 2 or y1 - y0 < 2:
        return
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    local = centre - (x0, y0)
    kind = rng.integers(0, 5)
    if kind == 0:
        axes = radius * rng.uniform(0.5, 1.2, 2)
        box = (tuple(map(float, local)), tuple(map(float, 2 * axes)), float(rng.uniform(0, 180)))
        cv2.ellipse(mask, box, 255, -1, cv2.LINE_AA)
    elif kind in (1, 2):
        box = (
            tuple(map(float, local)),
            tuple(map(float, 2 * radius * rng.uniform(0.35, 1.1, 2))),
            float(rng.uniform(0, 90) if rng.random() < 0.6 else 0.0),
        )
        cv2.fillConvexPoly(mask, _fixed_point(cv2.boxPoints(box)), 255, cv2.LINE_AA, 4)
    elif kind == 3:
        corners = int(rng.integers(3, 8))
        angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
        spokes = radius * rng.uniform(0.4, 1.4, corners)
        points = local + spokes[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        cv2.fillPoly(mask, [_fixed_point(points)], 255, cv2.LINE_AA, 4)
    elif rng.random() < 0.6:
        points = local + rng.normal(0, 0.7 * radius, (int(rng.integers(2, 5)), 2))
        thickness = int(max(1, rng.uniform(0.05, 0.35) * radius))
        cv2.polylines(mask, [_fixed_point(points)], False, 255, thickness, cv2.LINE_AA, 4)
    else:
        text = "".join(chr(c) for c in rng.integers(48, 91, 3))
        scale = radius / 18.0
        origin = (int(local[0] - radius), int(local[1] + 0.4 * radius))
        thickness = max(1, int(2.0 * scale))
        cv2.putText(mask, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness, cv2.LINE_AA)
    alpha = mask.astype(np.float32) / 255.0
    fill = _fill(mask.shape, rng)
    view = canvas[y0:y1, x0:x1]
    view += alpha * (fill - view)


def _fixed_point(points: np.ndarray) -> np.ndarray:
    """Points with the four fractional bits that OpenCV's drawing takes with shift = 4."""
    return np.round(np.asarray(points) * 16).astype(np.int32)

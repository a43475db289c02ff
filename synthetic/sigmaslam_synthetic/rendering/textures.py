"""Procedural textures: dead leaves whose leaves are themselves textured, and the surfaces of 3D worlds.

Sizes of leaves follow a power law (Lee, Mumford & Huang 2001), which gives the scale invariance and the occlusion
edges of natural images; what fills a leaf varies, because the diversity of the generator is what transfers.
"""

import cmath
import os
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from sigmaslam_synthetic.rendering.fills import (
    FILLS,
    bricks,
    cells,
    fixed_point,
    log_uniform,
    noise,
    normalised,
    plane,
    ramp,
    random_sign,
    strokes,
    vessels,
)
from sigmaslam_synthetic.rendering.photograph_textures import cut

_SMALLEST_LEAF = 3.0
# The patterns of an image: small leaves are cut of small sheets, large leaves of sheets as large as the image.
_SMALL_SHEETS, _SMALL_SHEET, _LARGE_SHEETS = 10, 96, 4
_CIRCLE = np.exp(2j * np.pi * np.arange(32) / 32)
_WAVES = _CIRCLE ** np.array([[2], [3], [5]])


def paint(kind: str, size: int, seed: int) -> np.ndarray:
    """A texture, a pure function of its arguments.

    Args:
        kind: one of `KINDS`, or a folder of photographs, a part of one of which is cut out.
        size: side in pixels.
        seed: not negative, below 2^64.
    Returns:
        (size, size) uint8, not writeable.
    """
    check_kind(kind)
    # The kind's own number keeps equal seeds of two kinds apart, whatever the order of KINDS.
    rng = np.random.default_rng((zlib.crc32(Path(kind).name.encode()), seed))
    if kind in _PAINTERS:
        image = _PAINTERS[kind]((size, size), rng)
    else:
        image = _pattern(kind, (size, size), rng) if kind in KINDS else cut(kind, size, rng)
    image.flags.writeable = False
    return image


def check_kind(kind: str) -> None:
    """Raises ValueError where `paint` knows no such kind; a folder must have a separator in its path."""
    if kind not in KINDS and not (os.sep in kind and Path(kind).is_dir()):
        raise ValueError(
            f"unknown texture {kind!r}; choose one of {', '.join(KINDS)}, or give the whole path of a folder of "
            "photographs"
        )


def dead_leaves(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A dead-leaves image with textured leaves.

    Args:
        shape: (height, width) in pixels.
        rng: source of all randomness; the same state gives the same image.
    Returns:
        (H, W) uint8.
    """
    area = shape[0] * shape[1]
    palette = _LeafPatterns(shape, rng)
    canvas = palette.fill(shape, rng)
    largest = max(0.35 * min(shape), _SMALLEST_LEAF + 1.0)
    radii = leaf_radii(rng, int(rng.integers(200, 900)), rng.uniform(1.1, 2.6), _SMALLEST_LEAF, largest)
    covered = np.cumsum(np.pi * radii**2)
    radii = radii[: int(np.searchsorted(covered, rng.uniform(1.5, 3.5) * area)) + 1]
    # Many small leaves on top keep corners everywhere, also where a large leaf fell last.
    small = leaf_radii(rng, int(rng.integers(50, 400)), 3.0, 2.0, 12.0)
    for radius in np.concatenate([radii, small]):
        _draw_leaf(canvas, float(radius), palette, rng)
    return _to_grey(canvas)


def leaf_radii(rng: np.random.Generator, count: int, exponent: float, low: float, high: float) -> np.ndarray:
    """Radii (count,) with density r^-exponent on [low, high], by inversion; the exponent is not 1."""
    power = 1.0 - exponent
    uniform = rng.random(count)
    return (low**power + uniform * (high**power - low**power)) ** (1.0 / power)


def leaf_outline(radius: float, rng: np.random.Generator) -> np.ndarray:
    """Corners (N, 2) of a random closed shape about the origin: ellipse, rectangle, polygon, wobbly blob or star."""
    style, turn, squeeze, *roll = rng.random(5).tolist()
    if style < 0.3:
        if roll[0] < 0.4:
            turn = 0.0  # as most things that people build
        u, v = radius * (0.35 + 0.75 * squeeze), radius * (0.35 + 0.75 * roll[1])
        corners = np.array([complex(-u, -v), complex(u, -v), complex(u, v), complex(-u, v)])
    elif style < 0.75:
        corners = radius * _CIRCLE
        if style > 0.5:  # three to eight corners
            chosen = rng.integers(0, len(_CIRCLE), 3 + int(6 * roll[0]))
            chosen.sort()
            corners = corners[chosen] * (0.4 + rng.random(len(chosen)))
        corners.imag *= 0.5 + 0.5 * squeeze
    elif style < 0.9:
        wobble = (0.3 * rng.random(3) * np.exp(2j * np.pi * rng.random(3))) @ _WAVES
        corners = radius * _CIRCLE * (1.0 + wobble.real)
    else:
        tips = 3 + int(6 * roll[0])
        corners = radius * np.exp(1j * np.pi / tips * np.arange(2 * tips))
        corners[::2] *= 0.25 + 0.4 * roll[1]
        corners.imag *= 0.5 + 0.5 * squeeze
    return (corners * cmath.rect(1.0, 2 * np.pi * turn)).view(np.float64).reshape(-1, 2)


class _LeafPatterns:
    """The fills and greys of one image: each image favours others, as a photograph does."""

    def __init__(self, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self._shape = shape
        self._names = tuple(FILLS)
        self._weights = np.cumsum(rng.dirichlet(np.full(len(FILLS), 0.8)))
        self._tone, self._spread = rng.uniform(60, 190), rng.uniform(40, 120)
        self._contrast = log_uniform(rng, 8.0, 50.0)
        self._sheets: dict[tuple[int, int], np.ndarray] = {}

    def fill(self, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        """What covers one leaf, (H, W) float32 in grey levels: a cut of one of the image's patterns."""
        u, v, number, top, left, flip = rng.random(6).tolist()
        contrast = np.float32(self._contrast * 2.5 * u * v)
        base = np.float32(min(250.0, max(5.0, self._tone + self._spread * rng.standard_normal())))
        small = max(shape) <= _SMALL_SHEET
        key = (int(small), int(number * (_SMALL_SHEETS if small else _LARGE_SHEETS)))
        sheet = self._sheets.get(key)
        if sheet is None:
            sheet = self._pattern((_SMALL_SHEET, _SMALL_SHEET) if small else self._shape, rng)
            self._sheets[key] = sheet
        y, x = int(top * (sheet.shape[0] - shape[0] + 1)), int(left * (sheet.shape[1] - shape[1] + 1))
        part = contrast * sheet[y : y + shape[0], x : x + shape[1]]
        part += base
        return np.asarray(part[::-1] if flip < 0.5 else part)

    def _pattern(self, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        number = int(np.searchsorted(self._weights[:-1], rng.random()))
        return FILLS[self._names[number]](shape, rng)


def _draw_leaf(canvas: np.ndarray, radius: float, palette: _LeafPatterns, rng: np.random.Generator) -> None:
    """Draws one leaf of a random shape at a random place into the canvas."""
    height, width = canvas.shape
    u, v, style, shaded, blurred, lit, slope_u, slope_v = rng.random(8).tolist()
    if radius < 6:
        style *= 0.9  # a word would be a blot
    thickness = 0
    if style < 0.8:
        points = leaf_outline(radius, rng)
    elif style < 0.92:
        points = rng.normal(0, 0.7 * radius, (int(rng.integers(2, 5)), 2))
        thickness = max(1, int(rng.uniform(0.05, 0.35) * radius))
    else:  # a word
        points = radius * np.array([[-1.1, -0.7], [1.6, 0.7]])
    # Only the box of the leaf that lies in the image is filled.
    corners = fixed_point(points + (u * width, v * height))
    left, top, wide, high = cv2.boundingRect(corners)
    x0, y0 = max(0, (left >> 4) - thickness - 1), max(0, (top >> 4) - thickness - 1)
    x1 = min(width, ((left + wide) >> 4) + thickness + 2)
    y1 = min(height, ((top + high) >> 4) + thickness + 2)
    if x1 - x0 < 2 or y1 - y0 < 2:
        return
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    corners -= np.array([16 * x0, 16 * y0], np.int32)
    if style < 0.8:
        cv2.fillPoly(mask, [corners], 255, cv2.LINE_AA, 4)
    elif style < 0.92:
        cv2.polylines(mask, [corners], False, 255, thickness, cv2.LINE_AA, 4)
    else:
        text, scale = "".join(chr(c) for c in rng.integers(48, 91, 3)), radius / 18.0
        origin = (int(corners[0, 0]) >> 4, int(corners[1, 1]) >> 4)
        cv2.putText(mask, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, max(1, int(2 * scale)), cv2.LINE_AA)
    view = canvas[y0:y1, x0:x1]
    if radius > 8 and shaded < 0.15:  # a shadow on what lies below
        shift = rng.uniform(-0.12, 0.12, 2) * radius
        shadow = cv2.warpAffine(mask, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), mask.shape[::-1])
        shadow = _softened(shadow, rng.uniform(0.05, 0.25) * radius)
        view *= np.float32(1.0) - np.float32(rng.uniform(0.1, 0.6) / 255.0) * shadow
    if radius > 6 and blurred < 0.15:  # out of focus
        mask = _softened(mask, rng.uniform(0.08, 0.4) * radius)
    fill = palette.fill(mask.shape, rng)
    if radius > 5 and lit < 0.35:  # uneven light
        rise_u, rise_v = 160.0 * (slope_u - 0.5), 160.0 * (slope_v - 0.5)
        fill += plane(fill.shape, rise_u / fill.shape[1], rise_v / fill.shape[0]) - np.float32(0.5 * (rise_u + rise_v))
    fill -= view
    fill *= mask * np.float32(1 / 255)
    view += fill


def _softened(mask: np.ndarray, width: float) -> np.ndarray:
    """A mask whose edges are about `width` pixels wide."""
    side = 2 * int(0.5 * width) + 1
    return np.asarray(cv2.blur(mask, (side, side), borderType=cv2.BORDER_REPLICATE))


def _to_grey(canvas: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.convertScaleAbs(np.maximum(canvas, 0)))  # rounds, and saturates at 255


def _pattern(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """One of the fills alone, of random brightness and contrast."""
    contrast = log_uniform(rng, 12.0, 70.0)
    return _to_grey(rng.uniform(70, 185) + contrast * FILLS[kind](shape, rng))


def _facade(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A wall of plaster or bricks with rows of framed windows."""
    size = min(shape)
    wall = rng.uniform(60, 210)
    canvas = wall + log_uniform(rng, 2.0, 14.0) * noise(shape, rng)
    if rng.random() < 0.6:
        canvas += log_uniform(rng, 6.0, 30.0) * bricks(shape, rng, log_uniform(rng, 0.012, 0.05) * size + 3.0, True)
    rows, columns = int(rng.integers(2, 6)), int(rng.integers(2, 7))
    storey, bay = shape[0] / rows, shape[1] / columns
    half = 0.5 * np.array([bay, storey]) * rng.uniform(0.4, 0.75, 2)
    frame = max(1, round(rng.uniform(0.01, 0.04) * storey))
    frame_grey = wall + random_sign(rng) * rng.uniform(30, 110)
    bars = rng.integers(0, 3, 2)
    if rng.random() < 0.6:  # a ledge below each storey, with its shadow
        for row in range(1, rows + 1):
            top, depth = int(row * storey) - 3 * frame, 1 + int(rng.uniform(0.5, 2.5) * frame)
            canvas[top : top + depth] += rng.uniform(15, 50)
            canvas[top + depth : top + 2 * depth] -= rng.uniform(15, 50)
    for row in range(rows):
        for column in range(columns):
            if rng.random() < 0.06:
                continue
            centre = (np.array([column, row]) + 0.5) * (bay, storey) + rng.normal(0, 0.6, 2)
            (x0, y0), (x1, y1) = (centre - half).astype(int), (centre + half).astype(int)
            if x1 - x0 < 6 or y1 - y0 < 6:
                continue
            _draw_window(canvas[y0:y1, x0:x1], frame, frame_grey, bars, rng)
            sill = canvas[y1 : y1 + 2 * frame, max(0, x0 - frame) : x1 + frame]
            sill[:frame] = frame_grey + 25
            sill[frame:] -= 40
    for _ in range(int(rng.integers(0, 3))):  # pipes
        x, w = int(rng.uniform(0, shape[1] - 8)), int(rng.integers(2, 7))
        canvas[:, x : x + w] = wall + rng.uniform(-70, 70) + 25 * np.sin(np.linspace(0, np.pi, w, dtype=np.float32))
    stain = noise(shape, rng, 0.5)
    return _to_grey(canvas * (1.0 + rng.uniform(0.02, 0.15) * stain))


def _draw_window(view: np.ndarray, frame: int, frame_grey: float, bars: np.ndarray, rng: np.random.Generator) -> None:
    """Draws one window: panes that reflect, blinds or curtains, bars, a frame."""
    shape = view.shape
    view[:] = rng.uniform(15, 130) + rng.uniform(4, 28) * ramp(shape, rng) + rng.uniform(2, 14) * noise(shape, rng)
    style = rng.random()
    if style < 0.25:  # blinds
        drop = int(rng.uniform(0.2, 1.0) * shape[0])
        lamellae = np.sin(np.arange(drop, dtype=np.float32) * np.float32(2 * np.pi / rng.uniform(3, 7)))
        view[:drop] = rng.uniform(90, 220) + 20 * lamellae[:, None]
    elif style < 0.5:  # curtains
        w = int(rng.uniform(0.15, 0.4) * shape[1])
        folds = rng.uniform(110, 220) + 25 * np.sin(np.arange(w, dtype=np.float32) * np.float32(rng.uniform(0.5, 1.5)))
        view[:, :w], view[:, shape[1] - w :] = folds, folds[::-1]
    for axis, count in enumerate(bars):
        for k in range(int(count)):
            place = (k + 1) * shape[1 - axis] // (int(count) + 1)
            bar = (slice(None), slice(place, place + frame))
            view[bar if axis == 0 else bar[::-1]] = frame_grey
    view[:frame], view[-frame:], view[:, :frame], view[:, -frame:] = (frame_grey,) * 4
    view[frame : 2 * frame] -= 30  # the frame's shadow on the pane


def _asphalt(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Dark fine grain with patches, stains, cracks and tar lines."""
    canvas = rng.uniform(45, 110) + log_uniform(rng, 3.0, 12.0) * noise(shape, rng, 0.6)
    for _ in range(int(rng.integers(0, 5))):
        patch = np.zeros(shape, np.uint8)
        outline = leaf_outline(rng.uniform(0.06, 0.3) * min(shape), rng) + rng.random(2) * shape[::-1]
        cv2.fillPoly(patch, [fixed_point(outline)], 255, cv2.LINE_AA, 4)
        canvas += (rng.normal(0, 16) / 255.0) * patch.astype(np.float32)
        if rng.random() < 0.5:
            cv2.polylines(patch, [fixed_point(outline)], True, 0, 3, cv2.LINE_AA, 4)
            canvas -= (rng.uniform(10, 40) / 255.0) * cv2.morphologyEx(patch, cv2.MORPH_GRADIENT, np.ones((3, 3)))
    grain = noise(shape, rng, rng.uniform(1.1, 1.5))
    canvas += log_uniform(rng, 6.0, 22.0) * np.where(grain > 1.2, 2.2 * grain - 1.5, grain)  # light stones stand out
    _draw_walks(canvas, int(rng.integers(0, 7)), 1, rng.uniform(-70, -25), 0.5, rng)
    _draw_walks(canvas, int(rng.integers(0, 4)), int(rng.integers(2, 8)), rng.uniform(-50, -20), 0.12, rng)
    return _to_grey(canvas)


def _grass(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Fine natural ground: blades over soil, in tufts."""
    canvas = rng.uniform(60, 140) + log_uniform(rng, 6.0, 25.0) * noise(shape, rng, rng.uniform(0.6, 0.9))
    for length in np.exp(rng.uniform(np.log(4), np.log(22), 2)):
        tufts = np.clip(0.7 + 0.5 * noise(shape, rng, 0.7), 0, None)
        canvas += log_uniform(rng, 8.0, 32.0) * tufts * strokes(shape, rng, float(length), rng.uniform(0.3, 1.5), 6000)
    return _to_grey(canvas + rng.uniform(2, 10) * noise(shape, rng, 1.2))


def _tissue(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """The smooth surface of an organ: mottling, lobules, vessels of two sizes."""
    canvas = rng.uniform(90, 180) + rng.uniform(5, 25) * noise(shape, rng, 0.4) + rng.uniform(1, 6) * noise(shape, rng)
    if rng.random() < 0.5:
        lobules = cv2.GaussianBlur(cells(shape, rng, log_uniform(rng, 8.0, 50.0)), (0, 0), rng.uniform(0.8, 2.5))
        canvas += rng.uniform(2, 9) * lobules
    size = min(shape)
    for width in (rng.uniform(0.008, 0.02) * size, rng.uniform(0.002, 0.006) * size):
        canvas += rng.uniform(6, 22) * vessels(shape, rng, max(1.0, float(width)))
    return _to_grey(canvas)


def _wood(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Planks with grain and knots."""
    height, width = shape
    base, contrast = rng.uniform(70, 190), log_uniform(rng, 10.0, 45.0)
    canvas = np.empty(shape, np.float32)
    plank = int(rng.uniform(0.12, 0.5) * height) + 8
    u = np.arange(width, dtype=np.float32)
    for top in range(-int(rng.integers(0, plank)), height, plank):
        rows = slice(max(0, top), min(height, top + plank))
        part = (rows.stop - rows.start, width)
        v = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None]
        # Rings are the level lines of a smooth field along the plank; a knot is a bump in it.
        field = v / np.float32(log_uniform(rng, 4.0, 14.0)) + rng.uniform(0.5, 4) * _stretched(part, 8.0, 0.4, rng)
        for _ in range(int(rng.integers(0, 3))):
            x, y = rng.uniform(0, width), rng.uniform(rows.start, rows.stop)
            reach, tall = rng.uniform(0.03, 0.12) * height, rng.uniform(2, 6)
            field += tall * np.exp(-(((u - x) / (2 * reach)) ** 2) - ((v - y) / reach) ** 2)
        rings = field - np.floor(field)
        fibres = _stretched(part, 16.0, 1.0, rng)
        grey = base + rng.normal(0, 14) + contrast * (1.5 * rings + rng.uniform(0.1, 0.6) * fibres)
        canvas[rows] = grey
        canvas[rows.start : rows.start + int(rng.integers(1, 4))] -= rng.uniform(20, 70)
    return _to_grey(canvas.T if rng.random() < 0.5 and height == width else canvas)


def _plaster(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A weakly textured wall with stains and hair cracks."""
    canvas = rng.uniform(110, 225) + log_uniform(rng, 1.5, 9.0) * noise(shape, rng, rng.uniform(0.8, 1.4))
    stains = np.clip(noise(shape, rng, 0.55) - rng.uniform(-0.5, 1.0), 0, None)
    canvas += random_sign(rng) * rng.uniform(4, 25) * stains
    _draw_walks(canvas, int(rng.integers(0, 5)), 1, rng.uniform(-50, -10), 0.4, rng)
    return _to_grey(canvas)


def _stretched(shape: tuple[int, int], factor: float, persistence: float, rng: np.random.Generator) -> np.ndarray:
    """Noise drawn out along the rows."""
    narrow = (shape[0], max(2, int(shape[1] / factor)))
    return normalised(cv2.resize(noise(narrow, rng, persistence), shape[::-1], interpolation=cv2.INTER_LINEAR))


def _draw_walks(
    canvas: np.ndarray, count: int, thickness: int, grey: float, wander: float, rng: np.random.Generator
) -> None:
    """Adds `grey` along random walks: cracks, joints."""
    if count == 0:
        return
    mask, size = np.zeros(canvas.shape, np.uint8), max(canvas.shape)
    steps = np.full((count, 60), size / 40.0)
    headings = rng.uniform(0, 2 * np.pi, (count, 1)) + np.cumsum(wander * rng.standard_normal(steps.shape), axis=1)
    headings += wander * rng.standard_normal(steps.shape)
    path = np.cumsum(np.stack([steps * np.cos(headings), steps * np.sin(headings)], axis=2), axis=1)
    path += rng.random((count, 1, 2)) * canvas.shape[::-1]
    cv2.polylines(mask, list(fixed_point(path)), False, 255, thickness, cv2.LINE_AA, 4)
    canvas += np.float32(grey / 255.0) * mask


_PAINTERS: dict[str, Callable[[tuple[int, int], np.random.Generator], np.ndarray]] = {
    "leaves": dead_leaves,
    "facade": _facade,
    "asphalt": _asphalt,
    "grass": _grass,
    "tissue": _tissue,
    "wood": _wood,
    "plaster": _plaster,
}
KINDS = (*_PAINTERS, *(name for name in FILLS if name not in ("flat", "ramp")))
"""Names that `paint` takes: dead leaves, surfaces of 3D worlds, and each pattern alone."""

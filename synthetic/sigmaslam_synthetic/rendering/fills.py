"""Procedural patterns that fill a leaf or a surface.

Each is a function (shape, rng) -> (H, W) float32 of zero mean and unit standard deviation (a flat one is zero
everywhere), so that a contrast means the same for all. Lengths are pixels.
"""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

Fill = Callable[[tuple[int, int], np.random.Generator], np.ndarray]

_GRAIN_SIZE = 1024
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&%$#@?!+=*<>{}/"


def flat(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Nothing at all."""
    return np.zeros(shape, np.float32)


def ramp(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A linear gradient, or a round one as on a ball."""
    angle = rng.uniform(0, 2 * np.pi)
    slope = plane(shape, np.cos(angle), np.sin(angle))
    if rng.random() < 0.5:
        return normalised(slope)
    side = plane(shape, -np.sin(angle), np.cos(angle))
    u, v = rng.uniform(-0.7, 0.7, 2).astype(np.float32) * max(shape)
    return normalised((slope - u) ** 2 + (side - v) ** 2)


def noise(shape: tuple[int, int], rng: np.random.Generator, persistence: float | None = None) -> np.ndarray:
    """Fractal noise: octaves of white noise, upsampled.

    Args:
        shape: (height, width).
        persistence: amplitude of an octave over that of the next coarser one; 1 is about the 1/f amplitude of
            natural images, less is smoother. Random by default.
    """
    if persistence is None:
        persistence = rng.uniform(0.45, 1.05)
    octaves = max(1, int(np.ceil(np.log2(max(shape)))))
    image, amplitude = _grain((2, 2), rng), 1.0
    for octave in range(octaves - 1, -1, -1):
        height, width = (max(2, -(-side >> octave)) for side in shape)
        amplitude *= persistence
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
        if amplitude > 2e-3:
            image = cv2.scaleAdd(_grain((height, width), rng), amplitude, image)
    return normalised(image[: shape[0], : shape[1]])


def stripes(shape: tuple[int, int], rng: np.random.Generator, period: float | None = None) -> np.ndarray:
    """Straight or warped stripes of a random profile (sine, bars, saw, bar code); `period` is random by default."""
    period = period or log_uniform(rng, 4.0, 48.0)
    angle = rng.uniform(0, np.pi)
    phase = plane(shape, np.cos(angle) / period, np.sin(angle) / period) + np.float32(rng.random())
    if rng.random() < 0.5:
        phase += log_uniform(rng, 0.1, 1.5) * noise(shape, rng, rng.uniform(0.25, 0.6))
    profile = _profile(rng, period)
    return normalised(profile[(phase * len(profile)).astype(np.int32) & (len(profile) - 1)])


def bricks(
    shape: tuple[int, int], rng: np.random.Generator, period: float | None = None, level: bool = False
) -> np.ndarray:
    """Bricks or tiles with mortar; `period` is the height of a row, random by default; `level` rows lie flat."""
    period = period or log_uniform(rng, 5.0, 48.0)
    angle = 0.0 if level else float(rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)]))
    length = period * rng.uniform(0.8, 3.5)
    along = plane(shape, -np.sin(angle) / period, np.cos(angle) / period)
    across = plane(shape, np.cos(angle) / length, np.sin(angle) / length)
    if rng.random() < 0.4:
        along += rng.uniform(0.02, 0.4) * noise(shape, rng, 0.4)
    row = np.floor(along)
    across += float(rng.choice([0.0, 0.5, rng.random()])) * row
    column = np.floor(across)
    shades = rng.standard_normal(64 * 64, np.float32)
    shade = shades[(row.astype(np.int32) & 63) * 64 + (column.astype(np.int32) & 63)]
    # Distance to the middle of the nearest joint, pixels.
    joint = np.minimum(period * (0.5 - np.abs(along - row - 0.5)), length * (0.5 - np.abs(across - column - 0.5)))
    width = max(0.5, rng.uniform(0.02, 0.12) * period)
    inside = np.clip(joint - width + 0.5, 0.0, 1.0)
    mortar = random_sign(rng) * rng.uniform(1.0, 4.0)
    return normalised(inside * (rng.uniform(0.1, 1.0) * shade - mortar))


def checker(shape: tuple[int, int], rng: np.random.Generator, period: float | None = None) -> np.ndarray:
    """A lattice of checks, dots or grid lines; `period` is the side of its cell, random by default."""
    period = period or log_uniform(rng, 6.0, 48.0)
    angle, aspect = rng.uniform(0, np.pi), rng.uniform(0.6, 1.6)
    along = np.sin(plane(shape, np.pi * np.cos(angle) / period, np.pi * np.sin(angle) / period))
    scale = np.pi / (aspect * period)
    across = np.sin(plane(shape, -np.sin(angle) * scale, np.cos(angle) * scale))
    sharpness = period / 3.0  # the edge of a check takes about a pixel
    style = rng.integers(3)
    if style == 0:
        return normalised(np.clip(along * across * sharpness, -1.0, 1.0))
    if style == 1:
        return normalised(np.clip((np.abs(along * across) - rng.uniform(0.3, 0.8)) * sharpness, -1.0, 1.0))
    distance = np.minimum(np.abs(along), np.abs(across)) - rng.uniform(0.05, 0.35)
    return normalised(np.clip(distance * sharpness, -1.0, 1.0))


def cells(shape: tuple[int, int], rng: np.random.Generator, spacing: float | None = None) -> np.ndarray:
    """Voronoi cells as shaded flats, domes or cracks, warped; `spacing` between seeds is random by default."""
    height, width = shape
    spacing = spacing or log_uniform(rng, 7.0, 60.0)
    # The diagram is made at half the resolution where its cells allow it, and then bent.
    shrink = 2.0 if spacing > 12 else 1.0
    rows, columns = int(height / shrink) + 3, int(width / shrink) + 3
    pitch = spacing / shrink
    lattice = np.mgrid[-1 : rows / pitch + 1, -1 : columns / pitch + 1].reshape(2, -1).T
    places = (pitch * (lattice + rng.uniform(0.3, 1.0) * rng.uniform(-0.5, 0.5, lattice.shape))).astype(np.int32)
    places = places[((places >= 0) & (places < (rows, columns))).all(axis=1)]
    seeds = np.ones((rows, columns), np.uint8)
    seeds[places[:, 0], places[:, 1]] = 0
    seeds[0, 0] = 0
    distance, label = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    inside = np.ones((rows, columns), np.uint8)
    inside[:, 1:][label[:, 1:] != label[:, :-1]] = 0
    inside[1:][label[1:] != label[:-1]] = 0
    border = np.clip(cv2.distanceTransform(inside, cv2.DIST_L2, 3) - rng.uniform(0.0, 0.08) * pitch, 0.0, 1.5)
    shade = rng.standard_normal(len(places) + 2).astype(np.float32)[label]
    style = rng.integers(4)
    if style == 0:
        image = shade
    elif style == 1:
        image = border * (rng.uniform(0.2, 0.8) * shade + 1.5 * random_sign(rng))
    elif style == 2:
        image = border * (1.5 - (distance / pitch) ** 2 * rng.uniform(1.0, 3.0) + 0.3 * shade)
    else:
        image = border
    return normalised(_bent(image.astype(np.float32), shape, 1.0 / shrink, rng))


def strokes(
    shape: tuple[int, int],
    rng: np.random.Generator,
    length: float | None = None,
    spread: float | None = None,
    most: int = 1500,
) -> np.ndarray:
    """Brush strokes, hairs or blades over one another.

    Args:
        shape: (height, width).
        length: typical length of a stroke; random by default.
        spread: standard deviation of their directions, radians; random by default.
        most: strokes at most, which is where their time goes.
    """
    height, width = shape
    length = length or log_uniform(rng, 6.0, 60.0)
    spread = log_uniform(rng, 0.05, 2.0) if spread is None else spread
    thickness = int(rng.integers(1, 4)) if length > 12 else 1
    count = int(np.clip(rng.uniform(0.5, 2.0) * height * width / (length * thickness), 4, most))
    angles = rng.uniform(0, 2 * np.pi) + spread * rng.standard_normal((count, 1))
    angles = angles + rng.uniform(0, 0.5) * rng.standard_normal((count, 1)) * np.array([-1.0, 0.0, 1.0])
    steps = length / 3.0 * rng.uniform(0.4, 1.6, (count, 1)) * np.ones(3)
    start = rng.uniform((-0.1 * width, -0.1 * height), (1.1 * width, 1.1 * height), (count, 2))[:, None]
    path = np.cumsum(np.stack([steps * np.cos(angles), steps * np.sin(angles)], axis=-1), axis=1)
    lines = fixed_point(np.concatenate([start, start + path], axis=1))
    image = np.full(shape, 128, np.uint8)
    # One call draws all strokes of one grey, the greys in random order.
    greys = 128 + 40 * rng.standard_normal(min(count, 24))
    for grey, group in zip(greys, np.array_split(lines, len(greys)), strict=True):
        cv2.polylines(image, list(group), False, float(np.clip(grey, 0, 255)), thickness, cv2.LINE_AA, 4)
    return normalised(image)


def glyphs(shape: tuple[int, int], rng: np.random.Generator, height: float | None = None) -> np.ndarray:
    """Rows of letters, of invented signs or of blocks; `height` of a row is random by default."""
    size = max(6, round(height or log_uniform(rng, 8.0, 44.0)))
    turned = rng.random() < 0.4
    rows, columns = [int(np.ceil(np.hypot(*shape)))] * 2 if turned else shape
    alphabet = _alphabet(rng, size)
    widths = np.array([glyph.shape[1] for glyph in alphabet])
    starts = np.cumsum(widths) - widths
    strip = np.concatenate(alphabet, axis=1)
    leading = int(rng.uniform(0.0, 0.8) * size)
    page: np.ndarray = np.zeros((rows + size, columns), np.uint8)
    space = rng.uniform(0.05, 0.3)
    for top in range(int(rng.integers(-size, 1)), rows, size + leading):
        if rng.random() < 0.08:
            continue  # the end of a paragraph
        chosen = rng.integers(1, len(alphabet), columns // int(widths.min()) + 1)
        chosen[rng.random(len(chosen)) < space] = 0
        # Columns of the strip, glyph after glyph.
        count = widths[chosen]
        place = np.arange(count.sum()) + np.repeat(starts[chosen] - np.cumsum(count) + count, count)
        line = strip[max(0, -top) :, place[:columns]]
        end = columns if rng.random() < 0.7 else int(rng.uniform(0.3, 1.0) * columns)
        page[max(0, top) : max(0, top) + len(line), : min(end, line.shape[1])] = line[:, :end]
    if turned:
        shift = np.array([[0, 0, shape[1] - columns], [0, 0, shape[0] - rows]]) / 2
        turn = cv2.getRotationMatrix2D((columns / 2, rows / 2), rng.uniform(0, 360), 1.0) + shift
        page = cv2.warpAffine(page, turn, shape[::-1], flags=cv2.INTER_LINEAR)
    return normalised(random_sign(rng) * page[: shape[0], : shape[1]].astype(np.float32))


def vessels(shape: tuple[int, int], rng: np.random.Generator, width: float | None = None) -> np.ndarray:
    """Dark branching, tapering vessels on smooth ground; `width` of the trunks is random by default."""
    size = max(shape)
    width = width or min(log_uniform(rng, 2.0, 10.0), 0.1 * size + 1.0)
    wander = rng.uniform(0.1, 0.35)
    dark = np.zeros(shape, np.uint8)
    trunks = int(rng.integers(1, 7))
    side = rng.uniform(0, 2 * np.pi, trunks)  # where a trunk enters the image, or where it lies
    start = np.array(shape[::-1]) * (0.5 + rng.uniform(0.1, 0.6) * np.stack([np.cos(side), np.sin(side)], axis=1))
    heading = side + np.pi + 0.5 * rng.standard_normal(trunks)
    thickness = width * rng.uniform(0.4, 1.0, trunks)
    for _ in range(12):  # one generation of branches at a time
        count = int(rng.integers(4, 14))
        headings = heading[:, None] + np.cumsum(wander * rng.standard_normal((len(heading), count)), axis=1)
        step = (1.5 * thickness + 0.012 * size + 1.0) * rng.uniform(0.6, 1.4, len(heading))
        path = np.cumsum(np.stack([np.cos(headings), np.sin(headings)], axis=2) * step[:, None, None], axis=1)
        path = np.concatenate([start[:, None], start[:, None] + path], axis=1)
        pixels = np.maximum(1, np.round(thickness)).astype(int)
        for pen in np.unique(pixels):
            lines, grey = fixed_point(path[pixels == pen]), float(thickness[pixels == pen].mean())
            cv2.polylines(dark, list(lines), False, 255.0 * min(1.0, 0.3 + 0.3 * grey), int(pen), cv2.LINE_AA, 4)
        share = rng.uniform(0.2, 0.8, len(heading))  # of the flow; Murray's law gives the widths
        turn = np.where(rng.random(len(heading)) < 0.5, -1.0, 1.0) * rng.uniform(0.3, 1.0, len(heading))
        off = rng.integers(0, count, len(heading))  # a twig leaves on the way
        branch = np.arange(len(heading))
        start = np.concatenate([path[:, -1], path[:, -1], path[branch, off]])
        heading = np.concatenate(
            [headings[:, -1] + turn * (1 - share), headings[:, -1] - turn * share, headings[branch, off] - 1.5 * turn]
        )
        thickness = np.concatenate([thickness * share ** (1 / 3), thickness * (1 - share) ** (1 / 3), 0.4 * thickness])
        alive = (thickness > 0.6) & (np.abs(start / shape[::-1] - 0.5) < 0.7).all(axis=1)
        kept = np.flatnonzero(alive)[:40]
        start, heading, thickness = start[kept], heading[kept], thickness[kept] * rng.uniform(0.75, 1.0)
    ground = rng.uniform(0.1, 0.4) * noise(shape, rng, rng.uniform(0.25, 0.5))
    soft = cv2.GaussianBlur(dark, (0, 0), rng.uniform(0.4, 1.2))
    return normalised(ground - (rng.uniform(2.0, 4.0) / 255.0) * soft)


FILLS: dict[str, Fill] = {
    "flat": flat,
    "ramp": ramp,
    "noise": noise,
    "stripes": stripes,
    "bricks": bricks,
    "checker": checker,
    "cells": cells,
    "strokes": strokes,
    "glyphs": glyphs,
    "vessels": vessels,
}


def normalised(image: np.ndarray) -> np.ndarray:
    """The image as float32 with zero mean and unit standard deviation; zero where it is constant."""
    mean, deviation = cv2.meanStdDev(image)
    factor = 1.0 / deviation[0, 0] if deviation[0, 0] > 1e-6 else 0.0
    return np.asarray((image.astype(np.float32, copy=False) - np.float32(mean[0, 0])) * np.float32(factor))


def fixed_point(points: np.ndarray) -> np.ndarray:
    """Points with the four fractional bits that OpenCV's drawing takes with shift = 4."""
    return np.asarray(np.rint(points * 16).astype(np.int32))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number in [low, high] whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_sign(rng: np.random.Generator) -> float:
    """1 or -1."""
    return 1.0 if rng.random() < 0.5 else -1.0


def plane(shape: tuple[int, int], slope_u: float, slope_v: float) -> np.ndarray:
    """slope_u u + slope_v v at each pixel (u, v), float32."""
    u, v = (np.arange(side, dtype=np.float32) for side in (shape[1], shape[0]))
    return np.asarray(np.float32(slope_u) * u + (np.float32(slope_v) * v)[:, None])


@cache
def _white() -> np.ndarray:
    """White noise, drawn once: a cut at a random place costs a hundredth of new numbers."""
    white = np.random.default_rng(0).standard_normal((_GRAIN_SIZE, _GRAIN_SIZE), np.float32)
    white.flags.writeable = False
    return white


def _grain(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """White Gaussian noise, (H, W) float32; small ones are new, large ones are cut from one sheet."""
    if shape[0] * shape[1] <= 256 or max(shape) > _GRAIN_SIZE:
        return rng.standard_normal(shape, np.float32)
    top, left = (int(rng.integers(0, _GRAIN_SIZE - side + 1)) for side in shape)
    return _white()[top : top + shape[0], left : left + shape[1]]


def _profile(rng: np.random.Generator, period: float) -> np.ndarray:
    """One period of a wave, (256,) float32, smoothed to what `period` pixels can show."""
    phase = (np.arange(256) + 0.5) / 256
    style = rng.integers(4)
    if style == 0:
        wave = np.sin(2 * np.pi * phase)
    elif style == 1:
        wave = np.where(phase < rng.uniform(0.15, 0.85), 1.0, -1.0)
    elif style == 2:
        wave = phase - 0.5
    else:  # a bar code: random greys that change at random places
        edges = np.sort(rng.random(int(rng.integers(2, 9))))
        wave = rng.standard_normal(len(edges) + 1)[np.searchsorted(edges, phase)]
    blur = np.exp(-0.5 * (2 * np.pi * np.arange(129) * 0.4 / period) ** 2)
    return np.fft.irfft(np.fft.rfft(wave) * blur).astype(np.float32)


def _bent(image: np.ndarray, shape: tuple[int, int], scale: float, rng: np.random.Generator) -> np.ndarray:
    """The image drawn to a shape, `scale` of its pixels to one, along slightly bent axes."""
    u, v = plane(shape, scale, 0.0), plane(shape, 0.0, scale)
    if rng.random() < 0.6:
        reach = rng.uniform(0.005, 0.03) * max(shape) * scale
        coarse = (shape[0] // 8 + 2, shape[1] // 8 + 2)
        for axis in (u, v):
            axis += reach * cv2.resize(noise(coarse, rng, 0.35), shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


def _alphabet(rng: np.random.Generator, size: int) -> list[np.ndarray]:
    """A blank and about twenty glyphs, each (size, width) uint8."""
    count, style = int(rng.integers(12, 28)), rng.random()
    alphabet: list[np.ndarray] = [np.zeros((size, max(2, size // 2)), np.uint8)]
    if style < 0.5:
        font, scale = int(rng.choice(_FONTS)), size / 33.0
        thickness = max(1, round(scale * rng.uniform(0.8, 3.0)))
        for letter in rng.choice(list(_LETTERS), count):
            (width, _), _ = cv2.getTextSize(letter, font, scale, thickness)
            glyph = np.zeros((size, max(2, width)), np.uint8)
            cv2.putText(glyph, letter, (0, int(0.75 * size)), font, scale, 255, thickness, cv2.LINE_AA)
            alphabet.append(glyph)
    elif style < 0.85:  # signs: strokes between the points of a 3 x 3 lattice, and dots
        thickness = max(1, round(size * rng.uniform(0.04, 0.16)))
        for _ in range(count):
            width = max(4, int(rng.uniform(0.4, 1.0) * size))
            glyph = np.zeros((size, width), np.uint8)
            points = (rng.integers(0, 3, (int(rng.integers(2, 6)), 2)) * 0.32 + 0.12) * (width, size)
            cv2.polylines(glyph, [fixed_point(points)], rng.random() < 0.3, 255, thickness, cv2.LINE_AA, 4)
            if rng.random() < 0.3:
                centre = tuple(int(c) for c in rng.uniform(0.2, 0.8, 2) * (width, size))
                cv2.circle(glyph, centre, max(1, size // 8), 255, -1, cv2.LINE_AA)
            alphabet.append(glyph)
    else:  # blocks, as of a matrix code
        side = int(rng.integers(3, 6))
        for _ in range(count):
            bits = (255 * rng.integers(0, 2, (side, side))).astype(np.uint8)
            alphabet.append(cv2.resize(bits, (size, size), interpolation=cv2.INTER_NEAREST))
    return alphabet

"""What the surgical worlds share: wet tissue, the light of an endoscope, instruments, motions."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion, rotation_exp
from sigmaslam_synthetic.motion.paths import Path, at_rest, noise, with_stops
from sigmaslam_synthetic.motion.random_motions import tool as tool_motion
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid
from sigmaslam_synthetic.scene import Body, Lights, Material, Texture
from sigmaslam_synthetic.worlds.episode import Wish
from sigmaslam_synthetic.worlds.part_models import Model, Part, bisect, covered_share, scaled

NEAR = 0.002
"""Nearest distance drawn in surgical worlds, metres."""

_STEP = 0.04  # seconds between knots of a path that is put together here


def endoscope_light(rng: np.random.Generator, distance: float) -> Lights:
    """A lamp beside the lens, of strength 1 at `distance` metres, and a little light that has been scattered about."""
    around, off = rng.uniform(0, 2 * np.pi), rng.uniform(0.002, 0.006)
    offset = (float(off * np.cos(around)), float(off * np.sin(around)), 0.0)
    return Lights(ambient=float(rng.uniform(0.06, 0.2)), lamp=distance**2, lamp_offset=offset)


def wet(rng: np.random.Generator, wish: Wish, tiles: tuple[float, float]) -> Material:
    """Tissue with vessels that shines where it is wet.

    Args:
        wish: whose textures are taken.
        tiles: sides of the two textures, metres; the first one makes the surface uneven.
    """
    kind = ("tissue", "tissue", "noise", "cells", "vessels")[int(rng.integers(5))]
    contrast = {"tissue": 1.3, "vessels": 1.0, "noise": 0.8, "cells": 0.25}[kind] * float(rng.uniform(0.7, 1.2))
    other = "tissue" if kind == "vessels" or rng.random() < 0.3 else "vessels"
    layers = (
        wish.texture(rng, kind, tiles[0], contrast),
        wish.texture(rng, other, tiles[1], float(rng.uniform(0.6, 1.2))),
    )
    return Material(
        brightness=float(rng.uniform(0.4, 0.7)),
        layers=layers,
        specular=float(rng.uniform(1.0, 3.0)),
        gloss=float(np.exp(rng.uniform(np.log(120), np.log(500)))),
        bump=float(rng.uniform(1.0, 4.0)) / (3.0 if kind == "cells" else 1.0),
    )


def lump(
    rng: np.random.Generator,
    radii: tuple[float, float, float],
    place: tuple[float, float, float],
    material: int,
    rings: int,
) -> Body:
    """An ellipsoid turned at random about z; its poles, where the texture is squeezed, lie to the sides.

    Args:
        radii: along, across and up, metres.
        place: of its centre, metres.
        material: index into `Scene.materials`.
        rings: of the ellipsoid.
    """
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * Rotation.from_euler("y", np.pi / 2)
    x, y, z = (float(v) for v in turn.as_rotvec())
    return Body(Ellipsoid((radii[2], radii[1], radii[0]), rings), material, place, (x, y, z))


def moved(
    rng: np.random.Generator, wish: Wish, make: Callable[[float], Path], turn: tuple[float, float, float]
) -> Path:
    """A path as `wish.motion` wants it.

    Args:
        wish: gives motion and duration.
        make: the domain's own way of moving for a duration, seconds.
        turn: rms of the turning on the spot about the body's x, y, z, radians.
    """
    duration = wish.duration
    if wish.motion == "rest":
        return at_rest(make(duration).poses(0.5 * duration), duration)
    if wish.motion == "rotation":
        return _turning(rng, make(duration).poses(0.5 * duration), duration, turn)
    if wish.motion == "loop":
        return _out_and_back(rng, make(duration), duration)
    if wish.motion == "stops":
        path = replace(make(0.75 * duration), stops=())
        ease = min(1.0, 0.5 * path.end)
        # Each lasts a second or more: so many make up for the shorter way.
        return with_stops(path, rng, 1 + int((duration - path.end) / (1.0 + ease)), ease)
    return make(duration)


def _turning(rng: np.random.Generator, pose: np.ndarray, duration: float, turn: tuple[float, float, float]) -> Path:
    t = _knots(duration)
    T = np.tile(pose, (len(t), 1, 1))
    T[:, :3, :3] = pose[:3, :3] @ rotation_exp(np.array(turn) * noise(rng, t, 3, 0.05, 0.25))
    return Path.from_poses(t, T)


def _out_and_back(rng: np.random.Generator, path: Path, duration: float) -> Path:
    """Half of the path and back again, turned a little otherwise on the way; ends where it starts."""
    t = _knots(duration)
    share = np.sin(np.pi * t / duration) ** 2
    T = path.poses(path.start + 0.5 * (path.end - path.start) * share)
    T[:, :3, :3] = T[:, :3, :3] @ rotation_exp(0.06 * share[:, None] * noise(rng, t, 3, 0.05, 0.3))
    return Path.from_poses(t, T)


def _knots(duration: float) -> np.ndarray:
    return np.linspace(0.0, duration, max(4, int(np.ceil(duration / _STEP)) + 1))


def mounted(path: Path, T_body_part: np.ndarray) -> Path:
    """The path of a part that is fixed to a body: T_world_part of T_world_body, with the same knots and stops."""
    return _through(path, _at_knots(path) @ T_body_part)


def placed(path: Path, T_world_frame: np.ndarray) -> Path:
    """The path in the world of a body whose `path` is given in a frame at rest there."""
    return _through(path, T_world_frame @ _at_knots(path))


def _at_knots(path: Path) -> np.ndarray:
    return replace(path, stops=()).poses(path.times)


def _through(path: Path, T: np.ndarray) -> Path:
    """Other poses at the knots of a path, with its stops."""
    return replace(Path.from_poses(path.times, T), stops=path.stops)


def carried(carrier: Path, path: Path, duration: float) -> Path:
    """The path in the world of a body whose `path` is given in the frame of a moving carrier."""
    t = _knots(duration)
    return Path.from_poses(t, carrier.poses(t) @ path.poses(t))


def reaching(
    rng: np.random.Generator, seconds: float, port: np.ndarray, target: np.ndarray, reach: float, sway: float
) -> Path:
    """An instrument that comes through a port and works about a target; z points along it, the origin is at its tip.

    Args:
        seconds: duration.
        port: (3,) where it comes from, metres.
        target: (3,) about which its tip moves, metres.
        reach: the tip stays within this distance of the target, metres.
        sway: rms of the port's own movement, metres.
    """
    centre = float(target[0]), float(target[1]), float(target[2])
    free = tool_motion(rng, seconds, centre, reach)
    tip = free.positions
    turning = (free.rotations - free.rotations.mean(axis=0)) / max(float(free.rotations.std()), 1e-9)
    z = tip - port - sway * np.stack([turning[:, 0], turning[:, 1], 0.3 * turning[:, 0]], axis=-1)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(target - port)))], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    roll = Rotation.from_rotvec((rng.uniform(-np.pi, np.pi) + 0.35 * turning[:, 2:]) * [0.0, 0.0, 1.0])
    return _through(free, rigid_motion(np.stack([x, np.cross(z, x), z], axis=-1) @ roll.as_matrix(), tip))


def instrument(
    rng: np.random.Generator,
    wish: Wish,
    path: Path,
    camera: Path,
    radii: tuple[float, float],
    share: float,
    first_material: int,
    rich: bool,
) -> tuple[list[Body], list[Material]]:
    """A rigid instrument of several bodies that all move with `path`; the first one is the shaft.

    Its tip is near the origin of the path's frame and points along z; the shaft reaches back to -z.

    Args:
        wish: whose textures are taken.
        path: T_world_instrument.
        camera: that sees it.
        radii: thinnest and thickest that the shaft may be, metres.
        share: of the image that it covers about, on average; within what `radii` allow.
        first_material: index that the first of the returned materials will have.
        rich: texture on all parts, and plates with markers.
    """
    seed = int(rng.integers(2**63))
    times = np.linspace(0.0, wish.duration, 7)[1:-1]

    def large(T: np.ndarray) -> np.ndarray:
        # covered_share is made for things that are metres away.
        result = T.copy()
        result[:, :3, 3] *= 30.0
        return result

    tool_poses, eye = large(path.poses(times)), large(camera.poses(times))

    def error(radius: float) -> float:
        model = scaled(_instrument(np.random.default_rng(seed), radius, first_material, rich), 30.0)
        return float(covered_share([(model, tool_poses)], eye).mean()) - share

    radius = bisect(error, *radii, steps=5)
    model = _instrument(np.random.default_rng(seed), radius, first_material, rich)
    # Orientations keep rigid exactly, positions to about a micrometre between the knots.
    T = _at_knots(path)
    bodies = [Body(part.shape, part.material, path=_through(path, T @ part.pose())) for part in model]
    return bodies, _instrument_materials(rng, wish, radius, rich)


def _instrument(rng: np.random.Generator, r: float, first_material: int, rich: bool) -> Model:
    """An instrument whose shaft has the radius r, metres."""
    steel, dark, marks, plain, jaw = range(first_material, first_material + 5)
    wrist, bite = rng.uniform(0.8, 1.8) * r, rng.uniform(1.5, 3.0) * r
    sleeve, gap = rng.uniform(3.0, 6.0) * r, rng.uniform(0.3, 1.2) * r
    opening, style = rng.uniform(0.05, 0.5), rng.random()
    back, length = -bite - wrist, 0.2
    parts = [
        Part(Cylinder(r, length, None, 20), plain if rich else steel, (0, 0, back - length / 2)),
        Part(Cylinder(1.12 * r, sleeve, None, 20), marks, (0, 0, back - gap - sleeve / 2)),
        Part(Cylinder(1.2 * r, 0.35 * r, None, 20), dark, (0, 0, back - gap)),
        Part(Cylinder(1.2 * r, 0.35 * r, None, 20), dark, (0, 0, back - gap - sleeve)),
        Part(Cylinder(0.95 * r, wrist, 0.6 * r, 16), steel, (0, 0, back + wrist / 2)),
        Part(Ellipsoid((0.7 * r, 0.7 * r, 0.7 * r), 10), dark, (0, 0, -bite)),
    ]
    for side in (-1.0, 1.0):
        angle = side * opening / 2
        sine, cosine = np.sin(angle), np.cos(angle)

        def on_jaw(x: float, z: float, s: float = sine, c: float = cosine) -> tuple[float, float, float]:
            return (x * c + z * s, 0.0, -bite - x * s + z * c)

        turn = (0.0, angle, 0.0)
        if style < 0.5:  # a grasper
            parts.append(Part(Box((0.35 * r, 0.8 * r, bite)), jaw, on_jaw(0.25 * side * r, bite / 2), turn))
            for k in range(4):  # its teeth
                place = on_jaw(0.02 * side * r, (0.35 + 0.18 * k) * bite)
                parts.append(Part(Box((0.3 * r, 0.7 * r, 0.07 * bite)), dark, place, turn))
        elif style < 0.8:  # scissors, a dissector
            shape = Cylinder(0.45 * r, bite, 0.12 * r, 10)
            parts.append(Part(shape, jaw, on_jaw(0.2 * side * r, bite / 2), turn))
        elif side > 0:  # a blunt probe
            parts.append(Part(Cylinder(0.4 * r, bite, 0.3 * r, 12), jaw, (0, 0, -bite / 2)))
            parts.append(Part(Ellipsoid((0.5 * r, 0.5 * r, 0.6 * r), 10), jaw))
    if rich:
        for side, material in ((-1.0, marks), (1.0, jaw)):  # plates with markers
            angle = side * rng.uniform(0.3, 1.3)
            place = (-1.25 * r * np.sin(angle), 1.25 * r * np.cos(angle), back - gap - sleeve - 2.5 * r)
            parts.append(Part(Box((3.2 * r, 0.3 * r, 3.6 * r)), material, place, (0.0, 0.0, angle)))
        for k, material in enumerate((dark, marks, jaw)):  # rings along the shaft
            place = (0, 0, back - gap - sleeve - (6 + 3 * k) * r)
            parts.append(Part(Cylinder((1.15 + 0.1 * k) * r, r, None, 20), material, place))
    return tuple(parts)


def _instrument_materials(rng: np.random.Generator, wish: Wish, r: float, rich: bool) -> list[Material]:
    """Steel, dark polymer, marks, a textured shaft, jaws: dark, as the lamp is near."""
    light = 2.0 if rich else 1.0
    scale = min(r, 0.005)  # a thick one has no coarser texture

    def of(kind: str, tile: float, contrast: float, brightness: float, specular: float) -> Material:
        layers: tuple[Texture, ...] = (wish.texture(rng, kind, tile * scale, contrast),)
        if rich:
            layers += (wish.texture(rng, "leaves", 0.6 * tile * scale, 0.5),)
        gloss = float(rng.uniform(40, 150))
        return Material(light * brightness * float(rng.uniform(0.7, 1.3)), layers, specular, gloss, bump=0.1)

    marks = ("glyphs", "checker", "leaves")[int(rng.integers(3))]
    wrap = ("leaves", "cells", "glyphs")[int(rng.integers(3))]
    return [
        of("stripes", 12.0, 0.25, 0.05, 0.3),
        of("strokes", 10.0, 0.3, 0.02, 0.1),
        of(marks, float(rng.uniform(8, 14)), float(rng.uniform(0.6, 1.0)), 0.14, 0.1),
        of(wrap, float(rng.uniform(8, 16)), float(rng.uniform(0.5, 0.8)), 0.12, 0.15),
        of("strokes", 8.0, float(rng.uniform(0.3, 0.6)), 0.06, 0.3),
    ]

"""What stands along a street and drives on it: cars, trees, lamps, signs; x is ahead, the ground is at z = 0."""

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel
from sigmaslam_synthetic.worlds.palette import Palette
from sigmaslam_synthetic.worlds.part_models import Model, Part

_ACROSS = (float(np.pi / 2), 0.0, 0.0)  # turns a cylinder's axis from z to y
# These turn a panel upright, its width level.
_FACING_BACK = tuple(Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]).as_rotvec().tolist())
_FACING_AHEAD = tuple(Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]]).as_rotvec().tolist())
_FACING_LEFT = (float(-np.pi / 2), 0.0, 0.0)


def car(rng: np.random.Generator, palette: Palette) -> Model:
    """A car, estate or van of three boxes on two axles, with lights and number plates; about 75 facets."""
    long, wide = rng.uniform(3.6, 4.7), rng.uniform(1.62, 1.85)
    high = rng.uniform(0.66, 0.8)
    paint, glass, dark = palette.choose("paint"), palette.choose("glass"), palette.choose("dark")
    cabin = long * rng.uniform(0.45, 0.66)
    rear = rng.choice([0.02, 0.06, 0.16]) * long
    middle = -long / 2 + rear + cabin / 2
    top = high + 0.28 + rng.uniform(0.46, 0.6)
    parts = [
        Part(Box((long, wide, high)), paint, (0.0, 0.0, 0.28 + high / 2)),
        Part(Box((cabin, 0.9 * wide, top - 0.28 - high)), glass, (middle, 0.0, 0.5 * (top + 0.28 + high))),
        Part(Box((0.84 * cabin, 0.86 * wide, 0.06)), paint, (middle - 0.02 * cabin, 0.0, top + 0.02)),
        *(Part(Box((0.09, 0.92 * wide, top - 0.3 - high)), paint, (middle + x * cabin, 0.0, 0.5 * (top + 0.28 + high)))
          for x in (-0.5, 0.02)),
        *(
            Part(Panel(0.025, 0.85 * high), dark, (x * long, y * (wide / 2 + 0.006), 0.28 + 0.5 * high), _FACING_LEFT)
            for y in (-1, 1)
            for x in (-0.2, 0.03, 0.22)
        ),
        *(Part(Panel(cabin, 0.05), dark, (middle, y * 0.46 * wide, top - 0.05), _FACING_LEFT) for y in (-1, 1)),
        *(Part(Box((0.14, 0.2, 0.14)), dark, (0.1 * long, y * (wide / 2 + 0.08), high + 0.36)) for y in (-1, 1)),
        *_axles(palette, (-0.31 * long, 0.31 * long), wide, rng.uniform(0.29, 0.34)),
        *_ends(rng, palette, long, wide, 0.7, dark),
    ]  # fmt: skip
    return tuple(parts)


def van(rng: np.random.Generator, palette: Palette) -> Model:
    """A delivery van with writing on its sides."""
    long, wide, high = rng.uniform(4.8, 6.0), rng.uniform(1.85, 2.0), rng.uniform(1.6, 2.1)
    paint, glass, dark = palette.choose("paint"), palette.choose("glass"), palette.choose("dark")
    writing = palette.choose("writing")
    side = Panel(0.55 * long, 0.6 * high)
    return (
        Part(Box((0.8 * long, wide, high)), paint, (-0.1 * long, 0.0, 0.35 + high / 2)),
        Part(Box((0.2 * long, 0.96 * wide, 0.55 * high)), paint, (0.4 * long, 0.0, 0.35 + 0.275 * high)),
        Part(Box((0.12 * long, 0.92 * wide, 0.36 * high)), glass, (0.35 * long, 0.0, 0.35 + 0.73 * high)),
        Part(Panel(0.75 * wide, 0.35 * high), glass, (-long / 2 - 0.012, 0.0, 0.35 + 0.72 * high), _FACING_BACK),
        Part(Panel(0.03, 0.95 * high), dark, (-long / 2 - 0.02, 0.0, 0.35 + 0.5 * high), _FACING_BACK),
        Part(side, writing, (-0.15 * long, wide / 2 + 0.01, 0.35 + 0.5 * high), _FACING_LEFT),
        Part(side, writing, (-0.15 * long, -wide / 2 - 0.01, 0.35 + 0.5 * high), _FACING_LEFT),
        *_axles(palette, (-0.3 * long, 0.33 * long), wide, 0.36),
        *_ends(rng, palette, long, wide, 0.8, dark),
    )


def truck(rng: np.random.Generator, palette: Palette) -> Model:
    """A truck with a box body that carries pictures or writing."""
    long, wide, high = rng.uniform(5.5, 8.0), rng.uniform(2.3, 2.5), rng.uniform(2.2, 2.8)
    cargo, paint, dark = palette.choose("cargo"), palette.choose("paint"), palette.choose("dark")
    rear, front = -long / 2 - 1.0, long / 2 - 1.0
    doors = [
        Part(Panel(0.04, high), dark, (rear - 0.012, y * wide, 1.0 + high / 2), _FACING_BACK) for y in (-0.25, 0, 0.25)
    ]
    return (
        Part(Box((long, wide, high)), cargo, (-1.0, 0.0, 1.0 + high / 2)),
        Part(
            Panel(0.6 * wide, 0.3 * high), palette.choose("writing"), (rear - 0.008, 0, 0.95 + high * 0.7), _FACING_BACK
        ),
        *doors,
        Part(Box((long + 1.6, 0.5 * wide, 0.3)), dark, (-0.2, 0.0, 0.8)),
        Part(Box((0.15, 0.95 * wide, 0.22)), palette.choose("plate"), (rear + 0.05, 0.0, 0.55)),
        Part(Box((1.8, 0.95 * wide, 1.9)), paint, (front + 1.1, 0.0, 1.5)),
        Part(Box((0.1, 0.8 * wide, 0.7)), palette.choose("glass"), (front + 1.98, 0.0, 1.9)),
        *_axles(palette, (rear + 1.0, rear + 2.1, front + 1.2), 0.98 * wide, 0.48),
        *(Part(Box((0.06, 0.35, 0.14)), palette.choose("lamp"), (rear - 0.02, y * wide, 0.82)) for y in (-0.4, 0.4)),
    )


def person(rng: np.random.Generator, palette: Palette) -> Model:
    """A standing or walking person, about 1.7 m."""
    coat, trousers = palette.choose("cloth"), palette.choose("cloth")
    stride = rng.uniform(0.05, 0.3)
    return (
        Part(Cylinder(0.07, 0.86, 0.1, 4), trousers, (0.0, 0.1, 0.43), (0.0, stride, 0.0)),
        Part(Cylinder(0.07, 0.86, 0.1, 4), trousers, (0.0, -0.1, 0.43), (0.0, -stride, 0.0)),
        Part(Ellipsoid((0.15, 0.23, 0.36), 4), coat, (0.0, 0.0, 1.12)),
        Part(Box((0.1, 0.1, 0.6)), coat, (0.0, 0.27, 1.1), (0.15, -stride, 0.0)),
        Part(Box((0.1, 0.1, 0.6)), coat, (0.0, -0.27, 1.1), (-0.15, stride, 0.0)),
        Part(Ellipsoid((0.1, 0.085, 0.13), 3), palette.choose("skin"), (0.0, 0.0, 1.6)),
    )


def tree(rng: np.random.Generator, palette: Palette) -> Model:
    """A trunk with boughs, a crown of a few lumps, and twigs that stick out of it; about 100 facets."""
    trunk, size = rng.uniform(1.8, 3.6), rng.uniform(1.2, 2.3)
    bark = palette.choose("bark")
    parts = [Part(Cylinder(rng.uniform(0.12, 0.28), trunk + 0.8, 0.1, 5), bark, (0.0, 0.0, trunk / 2))]
    leaves = palette.choose("leaves")
    for k in range(int(rng.integers(2, 5))):
        place = rng.normal(0, 0.4, 3) * size
        radii = size * rng.uniform(0.55, 0.95, 3)
        centre = (float(place[0]), float(place[1]), trunk + 0.75 * size + float(place[2]))
        parts.append(Part(Ellipsoid((radii[0], radii[1], radii[2]), 3 + (k == 0)), leaves, centre, _any_turn(rng)))
        for _ in range(3):
            direction = rng.standard_normal(3)
            x, y, z = np.array(centre) + 0.98 * radii.mean() * direction / np.linalg.norm(direction)
            twig = Panel(rng.uniform(0.3, 1.0), rng.uniform(0.2, 0.6))
            parts.append(Part(twig, palette.choose("leaves"), (float(x), float(y), float(z)), _any_turn(rng)))
    return tuple(parts)


def bush(rng: np.random.Generator, palette: Palette) -> Model:
    """Two or three low lumps of leaves."""
    leaves = palette.choose("leaves")
    parts = []
    for _ in range(int(rng.integers(1, 4))):
        r = rng.uniform(0.35, 0.8)
        x, y = rng.normal(0, 0.45, 2).tolist()
        parts.append(
            Part(Ellipsoid((r, r * rng.uniform(0.7, 1.1), 0.9 * r), 3), leaves, (x, y, 0.55 * r), _any_turn(rng))
        )
    for _ in range(3):
        x, y, z = rng.normal(0, [0.5, 0.5, 0.1]).tolist()
        parts.append(Part(Panel(0.3, rng.uniform(0.1, 0.4)), leaves, (x, y, 0.7 + z), _any_turn(rng)))
    return tuple(parts)


def lamp_post(rng: np.random.Generator, palette: Palette) -> Model:
    """A street lamp whose arm reaches to -y."""
    high, arm = rng.uniform(4.5, 8.0), rng.uniform(0.6, 1.8)
    metal = palette.choose("metal")
    return (
        Part(Cylinder(0.09, high, 0.06, 5), metal, (0.0, 0.0, high / 2)),
        Part(Cylinder(0.13, 1.0, None, 5), metal, (0.0, 0.0, 0.5)),
        Part(Cylinder(0.04, arm, None, 3), metal, (0.0, -arm / 2, high - 0.05), _ACROSS),
        Part(Box((0.28, 0.7, 0.13)), palette.choose("lamp"), (0.0, -arm, high - 0.1)),
        Part(Box((0.02, 0.5, 0.7)), palette.choose("writing"), (0.0, 0.0, rng.uniform(2.2, 3.2))),
    )


def sign(rng: np.random.Generator, palette: Palette) -> Model:
    """A road sign that faces back, round, square or broad."""
    high = rng.uniform(2.0, 3.0)
    post = Part(Cylinder(0.035, high, None, 4), palette.choose("metal"), (0.0, 0.0, high / 2))
    style, face = rng.random(), palette.choose("sign")
    if style < 0.4:
        disc = Cylinder(rng.uniform(0.28, 0.4), 0.03, None, int(rng.choice([3, 8])))
        plates = [Part(disc, face, (-0.06, 0.0, high - 0.1), (0.0, float(np.pi / 2), 0.0))]
    elif style < 0.75:
        side = rng.uniform(0.45, 0.75)
        plates = [Part(Box((0.03, side, side * rng.uniform(0.8, 1.5))), face, (-0.06, 0.0, high - 0.2))]
    else:
        plates = [
            Part(
                Box((0.04, rng.uniform(0.9, 1.5), 0.28)),
                palette.choose("sign"),
                (-0.06, rng.uniform(-0.2, 0.2), high - z),
            )
            for z in (0.1, 0.42, 0.74)
        ]
    return (post, *plates)


def small_thing(rng: np.random.Generator, palette: Palette) -> Model:
    """A bin, bollards, a cabinet, a bench, a column with posters or a hydrant."""
    style = int(rng.integers(6))
    if style == 0:
        return (
            Part(Cylinder(0.26, 0.85, 0.3, 7), palette.choose("metal"), (0.0, 0.0, 0.42)),
            Part(Cylinder(0.32, 0.08, 0.2, 7), palette.choose("dark"), (0.0, 0.0, 0.88)),
        )
    if style == 1:
        return tuple(
            Part(Cylinder(0.08, 0.95, 0.06, 4), palette.choose("sign"), (x, 0.0, 0.47)) for x in (-1.3, 0.0, 1.3)
        )
    if style == 2:
        size = (rng.uniform(0.7, 1.5), 0.4, rng.uniform(0.9, 1.5))
        return (
            Part(Box(size), palette.choose("cargo"), (0.0, 0.0, size[2] / 2)),
            Part(Panel(0.5, 0.4), palette.choose("writing"), (0.1, -0.206, 0.65), _FACING_LEFT),
        )
    if style == 3:
        wood = palette.choose("wood")
        return (
            Part(Box((1.6, 0.45, 0.06)), wood, (0.0, 0.0, 0.45)),
            Part(Box((1.6, 0.05, 0.4)), wood, (0.0, 0.24, 0.75)),
            *(Part(Box((0.08, 0.45, 0.45)), palette.choose("dark"), (x, 0.0, 0.22)) for x in (-0.65, 0.65)),
        )
    if style == 4:
        return (
            Part(Cylinder(0.55, 2.6, None, 10), palette.choose("poster"), (0.0, 0.0, 1.3)),
            Part(Cylinder(0.68, 0.3, 0.3, 8), palette.choose("dark"), (0.0, 0.0, 2.75)),
        )
    metal = palette.choose("sign")
    return (
        Part(Cylinder(0.13, 0.7, 0.1, 6), metal, (0.0, 0.0, 0.35)),
        Part(Ellipsoid((0.14, 0.14, 0.12), 3), metal, (0.0, 0.0, 0.72)),
        Part(Cylinder(0.06, 0.4, None, 4), metal, (0.0, 0.0, 0.5), _ACROSS),
    )


def shelter(rng: np.random.Generator, palette: Palette) -> Model:
    """A bus shelter, open to -y, with a poster."""
    long = rng.uniform(2.5, 4.0)
    dark = palette.choose("dark")
    return (
        Part(Box((long, 1.4, 0.1)), palette.choose("metal"), (0.0, 0.0, 2.4)),
        *(Part(Box((0.06, 0.06, 2.4)), dark, (x * long, y, 1.2)) for x in (-0.48, 0.48) for y in (-0.6, 0.65)),
        Part(Box((0.04, 1.2, 1.7)), palette.choose("poster"), (-0.48 * long, 0.0, 1.2)),
        Part(Panel(0.5 * long, 1.4), palette.choose("glass"), (0.2 * long, 0.66, 1.3), _FACING_LEFT),
        Part(Box((0.7 * long, 0.35, 0.06)), palette.choose("wood"), (0.0, 0.4, 0.48)),
    )


def _axles(palette: Palette, at: tuple[float, ...], wide: float, radius: float) -> list[Part]:
    """A pair of wheels each, as one cylinder: what lies between them is out of sight."""
    wheels = Cylinder(radius, wide + 0.03, None, 8)
    return [Part(wheels, palette.choose("tyre"), (x, 0.0, radius), _ACROSS) for x in at]


def _ends(rng: np.random.Generator, palette: Palette, long: float, wide: float, z: float, dark: int) -> list[Part]:
    """Lights, number plates and bumpers at both ends."""
    parts = []
    lamp, plate = palette.choose("lamp"), palette.choose("plate")
    lamp_size = (rng.uniform(0.2, 0.4), rng.uniform(0.1, 0.28))
    for sign_, turn in ((-1, _FACING_BACK), (1, _FACING_AHEAD)):
        x = sign_ * (long / 2 + 0.012)
        parts += [Part(Panel(*lamp_size), lamp, (x, y * wide, z), turn) for y in (-0.38, 0.38)]
        parts.append(Part(Panel(0.52, 0.14), plate, (x, 0.0, z - 0.15), turn))
        parts.append(Part(Box((0.1, 0.94 * wide, 0.16)), dark, (sign_ * (long / 2 + 0.02), 0.0, 0.4)))
    return parts


def _any_turn(rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, z = rng.uniform(-2.0, 2.0, 3).tolist()
    return x, y, z

"""Bodies by a few numbers each: what scene.json holds, turned into facets.

Every shape stands in its own frame. Surfaces of one body show different parts of their texture.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter

from sigmaslam_synthetic.geometry import arc_length, carried_normals
from sigmaslam_synthetic.rendering.facets import Facets, flat, grid, grid_mesh, join, mesh

# Faces of one body begin this far apart in their texture, metres times the body's size: no two look alike.
_FACE_STEP = np.array([1.37, 2.71])


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle in the plane z = 0, centred, seen from both sides; its normal is z.

    Attributes:
        width, height: metres along x and y.
    """

    width: float
    height: float

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        w, h = self.width / 2, self.height / 2
        return flat(np.array([[-w, -h, 0.0], [w, -h, 0.0], [-w, h, 0.0]]))


@dataclass(frozen=True, slots=True)
class Box:
    """A closed box, centred.

    Attributes:
        size: metres along x, y, z.
    """

    size: tuple[float, float, float]

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        unit, size = _unit_box(), np.array(self.size)
        edge_u, edge_v = unit.edge_u * size, unit.edge_v * size
        uv = np.zeros((6, 3, 2))
        uv[:, 0] = 0.5 * size.max() * np.arange(6)[:, None] * _FACE_STEP
        # Of an edge along an axis the sum of the magnitudes is its length.
        uv[:, 1, 0], uv[:, 2, 1] = np.abs(edge_u).sum(axis=1), np.abs(edge_v).sum(axis=1)
        return replace(unit, origin=unit.origin * size, edge_u=edge_u, edge_v=edge_v, uv=uv)


@cache
def _unit_box() -> Facets:
    """The box of side 1, from which all others are stretched: scenes have thousands."""
    faces = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            centre, u, v = np.zeros(3), np.zeros(3), np.zeros(3)
            # Upright faces run their texture's rows along z.
            along, across = ((1, 2), (0, 2), (0, 1))[axis]
            centre[axis], u[along], v[across] = 0.5 * sign, 0.5, 0.5
            if np.cross(u, v)[axis] * sign < 0:
                u = -u
            faces.append(flat(np.array([centre - u - v, centre + u - v, centre - u + v]), closed=True))
    return join(faces)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A closed cylinder or cone frustum about z, centred.

    Attributes:
        radius: metres at the bottom.
        length: metres along z.
        top: radius at the top; the bottom's unless given.
        sides: number of flat sides that stand for the round.
    """

    radius: float
    length: float
    top: float | None = None
    sides: int = 16

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        top = self.radius if self.top is None else self.top
        angle = 2 * np.pi * np.arange(self.sides + 1) / self.sides
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points = np.zeros((self.sides + 1, 2, 3))
        points[:, 0, :2], points[:, 1, :2] = self.radius * ring, top * ring
        points[:, 0, 2], points[:, 1, 2] = -self.length / 2, self.length / 2
        uv = np.zeros((self.sides + 1, 2, 2))
        uv[:, :, 0] = (max(self.radius, top) * angle)[:, None]
        uv[:, 1, 1] = self.length
        outward = np.zeros((self.sides + 1, 2, 3))
        outward[:, :, :2] = ring[:, None]
        outward[:, :, 2] = (self.radius - top) / self.length
        outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
        parts = [grid_mesh(points, uv, outward, closed=True)]
        for z, radius, sign in ((-self.length / 2, self.radius, -1.0), (self.length / 2, top, 1.0)):
            if radius > 0:
                rim = np.concatenate([radius * ring[:-1], np.full((self.sides, 1), z)], axis=1)
                fan = np.stack([np.zeros(self.sides - 2), *(np.arange(k, self.sides - 2 + k) for k in (1, 2))], axis=1)
                fan = fan.astype(np.int64) if sign > 0 else fan[:, ::-1].astype(np.int64)
                normal = np.tile([0.0, 0.0, sign], (self.sides, 1))
                parts.append(mesh(rim, rim[:, :2], normal, fan, closed=True))
        for k, part in enumerate(parts):
            part.uv[:, 0] += k * max(self.radius, top) * _FACE_STEP
        return join(parts)


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """A closed ellipsoid, centred.

    Attributes:
        radii: metres along x, y, z.
        rings: number of flat rings from pole to pole.
    """

    radii: tuple[float, float, float]
    rings: int = 16

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        radii = np.array(self.radii)
        polar, around = np.meshgrid(
            np.linspace(0, np.pi, self.rings + 1), np.linspace(0, 2 * np.pi, 2 * self.rings + 1), indexing="ij"
        )
        direction = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
        outward = direction / radii
        outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
        # The texture wraps round; towards the poles it is squeezed, as on any globe.
        uv = np.stack([around * radii[:2].mean(), polar * radii.mean()], axis=-1)
        return grid_mesh(direction * radii, uv, outward, closed=True)


@dataclass(frozen=True, slots=True)
class Terrain:
    """A smooth height field over the plane, seen from both sides; its normal points to +z.

    Attributes:
        x, y: grid lines, metres.
        z: heights, one row a grid line of x, metres.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    z: tuple[tuple[float, ...], ...]

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        x, y = np.meshgrid(self.x, self.y, indexing="ij")
        points = np.stack([x, y, np.array(self.z)], axis=-1)
        return grid(points, points[..., :2].copy())


@dataclass(frozen=True, slots=True)
class Sheet:
    """A smooth bumpy surface about z = 0, seen from both sides; its normal points to +z.

    Attributes:
        size: metres along x and y.
        bumps: height of the bumps (standard deviation), metres.
        length: typical distance between bumps, metres.
        seed: of the bumps.
        cells: grid cells along either side.
    """

    size: tuple[float, float]
    bumps: float
    length: float
    seed: int
    cells: int = 96

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        x, y = (np.linspace(-s / 2, s / 2, self.cells + 1) for s in self.size)
        points = np.zeros((self.cells + 1, self.cells + 1, 3))
        points[..., 0], points[..., 1] = np.meshgrid(x, y, indexing="ij")
        points[..., 2] = self.bumps * _smooth_noise(
            (self.cells + 1, self.cells + 1), self.length * self.cells / max(self.size), self.seed
        )
        return grid(points, points[..., :2].copy())


@dataclass(frozen=True, slots=True)
class Tube:
    """A bent, folded tube seen from within, closed at its far end; normals point to the axis.

    Attributes:
        centreline: points of the axis, metres; at least 4, joined by a smooth curve.
        radius: mean radius, metres.
        folds: depth of the ring folds (haustra), metres.
        fold_step: distance of the folds along the axis, metres.
        bumps: size of random bumps (standard deviation), metres.
        seed: of folds and bumps.
        rings, sides: grid of the wall.
    """

    centreline: tuple[tuple[float, float, float], ...]
    radius: float
    folds: float
    fold_step: float
    bumps: float
    seed: int
    rings: int = 220
    sides: int = 72

    def facets(self) -> Facets:
        """The facets in the shape's own frame."""
        knots = np.array(self.centreline)
        arc = arc_length(knots)
        curve = CubicSpline(arc, knots)
        s = np.linspace(0.0, arc[-1], self.rings + 1)
        centre, tangent = curve(s), curve(s, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # Two unit vectors across the axis that turn as little as possible along it.
        side = carried_normals(tangent, np.eye(3)[int(np.argmin(np.abs(tangent[0])))])
        up = np.cross(tangent, side)
        angle = 2 * np.pi * np.arange(self.sides + 1) / self.sides
        rng = np.random.default_rng((self.seed, 7))
        noise = _smooth_noise((self.rings + 1, self.sides), self.sides / 5.0, self.seed)
        noise = np.concatenate([noise, noise[:, :1]], axis=1)
        # Folds run round most of the wall, each a little askew.
        phase = 2 * np.pi * s[:, None] / self.fold_step + 1.2 * np.sin(angle + rng.uniform(0, 2 * np.pi))
        phase = phase + 0.7 * np.sin(2 * np.pi * s[:, None] / (5.3 * self.fold_step) + rng.uniform(0, 2 * np.pi))
        fold = np.exp(3.0 * (np.cos(phase) - 1.0)) * (0.6 + 0.4 * np.cos(3 * angle + rng.uniform(0, 2 * np.pi)))
        radius = self.radius - self.folds * fold + self.bumps * noise
        # The far end is rounded off to a cap.
        to_end = np.clip((arc[-1] - s) / (1.5 * self.radius), 0.0, 1.0)
        radius = radius * np.sqrt(np.maximum(1.0 - (1.0 - to_end) ** 2, 1e-6))[:, None]
        ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
        points = centre[:, None] + radius[..., None] * ring
        uv = np.stack(np.broadcast_arrays(s[:, None], self.radius * angle[None]), axis=-1)
        # Along the axis times round it: the normal points inwards.
        return grid(points, uv, wraps=True, closed=True)


Shape = Panel | Box | Cylinder | Ellipsoid | Terrain | Sheet | Tube
SHAPES: tuple[type[Shape], ...] = (Panel, Box, Cylinder, Ellipsoid, Terrain, Sheet, Tube)


def _smooth_noise(shape: tuple[int, int], length: float, seed: int) -> np.ndarray:
    """Noise of zero mean and unit standard deviation whose bumps are about `length` cells apart."""
    rng = np.random.default_rng((seed, 11))
    white = rng.standard_normal(shape)
    noise = np.zeros(shape)
    for share, scale in ((1.0, 1.0), (0.35, 0.4)):
        blurred = gaussian_filter(white, max(0.35 * length * scale, 0.5), mode="wrap")
        noise += share * blurred / blurred.std()
    return np.asarray((noise - noise.mean()) / noise.std())

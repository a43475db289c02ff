"""What the renderer draws: flat facets, each a parallelogram or a triangle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.table import Table


@dataclass(frozen=True, slots=True)
class Facets(Table):
    """F facets o + a e_u + b e_v with a, b in [0, 1], or with a, b >= 0 and a + b <= 1 for a triangle.

    Attributes:
        origin, edge_u, edge_v: (F, 3) metres, in the frame of their body.
        triangle: (F,) bool.
        uv: (F, 3, 2) place on the surface, metres: at the origin, and its change along edge_u and along edge_v.
        normals: (F, 3, 3) outward normals in the same form; not of unit length in between.
        closed: (F,) bool, part of a closed body whose inside is never seen, so that back sides are not drawn.
        surface: (F,) int, facets of one smooth surface share a number.
    """

    origin: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    triangle: np.ndarray
    uv: np.ndarray
    normals: np.ndarray
    closed: np.ndarray
    surface: np.ndarray

    def placed(self, T: np.ndarray) -> "Facets":
        """The same facets after a rigid motion T (4, 4)."""
        R = T[:3, :3]
        origin = self.origin @ R.T + T[:3, 3]
        edge_u, edge_v, normals = (vectors @ R.T for vectors in (self.edge_u, self.edge_v, self.normals))
        return replace(self, origin=origin, edge_u=edge_u, edge_v=edge_v, normals=normals)


def join(parts: Sequence[Facets]) -> Facets:
    """All facets in one table; the numbers of the surfaces stay distinct."""
    first = np.cumsum([0, *(int(part.surface.max()) + 1 for part in parts)])
    return Facets.concatenate([replace(p, surface=p.surface + k) for p, k in zip(parts, first[:-1], strict=True)])


def flat(corners: np.ndarray, *, closed: bool = False) -> Facets:
    """One facet from its origin and the ends of its two edges, (3, 3); texture axes run along the edges.

    The normal is e_u x e_v.
    """
    origin, edge_u, edge_v = corners[0], corners[1] - corners[0], corners[2] - corners[0]
    along, across = float(np.linalg.norm(edge_u)), float(np.linalg.norm(edge_v))
    normal = np.cross(edge_u, edge_v)
    uv = np.array([[[0.0, 0.0], [along, 0.0], [0.0, across]]])
    normals = np.zeros((1, 3, 3))
    normals[0, 0] = normal / np.linalg.norm(normal)
    return Facets(
        origin[None],
        edge_u[None],
        edge_v[None],
        np.zeros(1, dtype=bool),
        uv,
        normals,
        np.array([closed]),
        np.zeros(1, dtype=np.int64),
    )


def mesh(
    points: np.ndarray, uv: np.ndarray, normals: np.ndarray, corners: np.ndarray, *, closed: bool = False
) -> Facets:
    """A smooth surface of triangles.

    Args:
        points: (P, 3) vertices, metres.
        uv: (P, 2) place of each vertex on the surface, metres.
        normals: (P, 3) outward unit normals.
        corners: (F, 3) vertices of each triangle; those without an area are left out.
        closed: whether the surface closes on itself.
    """
    at = points[corners]
    area = np.linalg.norm(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]), axis=-1)
    corners = corners[area > 1e-9 * area.max()]
    at, place, normal = points[corners], uv[corners], normals[corners]
    count = len(corners)

    def as_edges(values: np.ndarray) -> np.ndarray:
        return np.stack([values[:, 0], values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]], axis=1)

    origin, edge_u, edge_v = as_edges(at).transpose(1, 0, 2)
    return Facets(
        origin,
        edge_u,
        edge_v,
        np.ones(count, dtype=bool),
        as_edges(place),
        as_edges(normal),
        np.full(count, closed),
        np.zeros(count, dtype=np.int64),
    )


def grid(points: np.ndarray, uv: np.ndarray, *, wraps: bool = False, closed: bool = False) -> Facets:
    """A smooth surface over a grid of vertices; each cell becomes two triangles.

    Args:
        points: (m, n, 3) vertices, metres; the normal is that of (next row - this) x (next column - this).
        uv: (m, n, 2) place of each vertex on the surface, metres.
        wraps: whether the last column of vertices is the first one again.
        closed: whether only its front side is ever seen.
    """
    across = np.gradient(points, axis=1)
    if wraps:
        across[:, [0, -1]] = ((points[:, 1] - points[:, -2]) / 2)[:, None]
    normal = np.cross(np.gradient(points, axis=0), across)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return grid_mesh(points, uv, normal, closed=closed)


def grid_mesh(points: np.ndarray, uv: np.ndarray, normals: np.ndarray, *, closed: bool = False) -> Facets:
    """As `mesh`, over a grid of vertices (m, n, 3), (m, n, 2), (m, n, 3); each cell becomes two triangles."""
    m, n = points.shape[:2]
    index = np.arange(m * n).reshape(m, n)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
    corners = np.concatenate([np.stack([a, b, c], axis=1), np.stack([d, c, b], axis=1)])
    return mesh(points.reshape(-1, 3), uv.reshape(-1, 2), normals.reshape(-1, 3), corners, closed=closed)

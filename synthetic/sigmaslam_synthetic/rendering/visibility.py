"""Which facet is seen where: scanline spans on a pinhole grid, exact rays in between.

In the frame of a view a facet holds the points o + a e_u + b e_v. Seen from grid place (u, v) this is one 3x3 map,
(a, b, 1) / z = [e_u e_v o]^-1 K^-1 (u, v, 1), so that its inside is a set of linear inequalities in u on every row: a
span. All spans of all facets and views are filled at once, the nearest wins. Rays between the grid's places (distorted
pixels, sub-samples, projected points, shadows) are tested exactly against what the four places around them see.

Coordinates come first in arrays here, (2, N) and (3, N): what is computed for each coordinate then runs over long rows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from sigmaslam.geometry.camera import CameraModel

_FRAGMENTS = 1 << 22  # filled at a time; bounds the memory
_SPAN_TOLERANCE = 1e-6  # pixels by which a span is widened, so that neighbours leave no crack
_INSIDE_TOLERANCE = 1e-9
_NEARER = 1e-5  # relative; what is nearer by less does not hide
_FAR_NEARER = 0.02
_FINER = 1.4  # the grid of a distorted camera than its pixels, for outlines lie between its places
_WIDEST_SLOPE = 4.0  # tangent of the widest ray that is drawn
_MIN_INVERSE_DEPTH = 1e-12
# Places of the grid around a ray, from the corner of its cell: the cell's own four, and the ring around them.
_NEXT = ((0, 0), (1, 0), (0, 1), (1, 1))
_RING = tuple((du, dv) for dv in range(-1, 3) for du in range(-1, 3) if (du, dv) not in _NEXT)


class Eye:
    """A camera and the ideal pinhole grid that covers its view.

    Args:
        camera: intrinsics and distortion; without distortion grid and pixels are the same.
    """

    def __init__(self, camera: CameraModel) -> None:
        self.camera = camera
        self._centres: dict[tuple[str, tuple[float, float]], Tensor] = {}
        self.ideal = camera.distortion_model == "none" and camera.skew == 0.0
        if self.ideal:
            self.fx, self.fy, self.cx, self.cy = camera.fx, camera.fy, camera.cx, camera.cy
            self.width, self.height = camera.width, camera.height
            return
        v, u = np.mgrid[-0.5 : camera.height : 1.0, -0.5 : camera.width : 1.0]
        rays = camera.unproject(np.stack([u, v], axis=-1))[..., :2]
        rays = rays[np.isfinite(rays).all(axis=-1) & (np.abs(rays) < _WIDEST_SLOPE).all(axis=-1)]
        low, high = rays.min(axis=0), rays.max(axis=0)
        self.fx, self.fy = _FINER * camera.fx, _FINER * camera.fy
        self.cx, self.cy = 1.0 - low[0] * self.fx, 1.0 - low[1] * self.fy
        self.width, self.height = (int(np.ceil((high - low)[k] * (self.fx, self.fy)[k])) + 3 for k in (0, 1))

    @property
    def matrix(self) -> np.ndarray:
        """Calibration of the grid, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def centres(self, device: torch.device, offset: tuple[float, float] = (0.0, 0.0)) -> Tensor:
        """Places on the grid of all pixels' centres, shifted by `offset` pixels, (2, H W) float64."""
        key = (str(device), offset)
        if key not in self._centres:
            v, u = np.mgrid[0 : self.camera.height, 0 : self.camera.width].astype(np.float64)
            pixels = np.stack([(u + offset[0]).ravel(), (v + offset[1]).ravel()])
            self._centres[key] = self.to_grid(torch.from_numpy(pixels).to(device))
        return self._centres[key]

    def spacing(self, device: torch.device) -> Tensor:
        """Side of the square on the grid that a pixel covers, (H W,) float32."""
        if self.ideal:
            return torch.ones(self.width * self.height, device=device)
        right, left, below, above = (
            self.centres(device, offset) for offset in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
        )
        across, down = right - left, below - above
        return (across[0] * down[1] - across[1] * down[0]).abs().sqrt().float()

    def to_grid(self, pixels: Tensor) -> Tensor:
        """Places on the grid of pixels (2, N) float64; NaN where the distortion has no ray."""
        if self.ideal:
            return pixels
        rays = self.camera.unproject(pixels.T.cpu().numpy())[:, :2]
        return self._from_slope(torch.from_numpy(rays.T.copy()).to(pixels.device))

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels and places on the grid, each (2, N), of points (3, N) in the camera frame; z > 0 is up to you."""
        slope = points[:2] / points[2]
        places = self._from_slope(slope)
        if self.ideal:
            return places, places
        pixels = torch.from_numpy(self.camera.project(points.T.cpu().numpy()).T.copy()).to(points.device)
        # Beyond the fold of a distortion a point far outside comes back into the image.
        return torch.where((slope.abs() < _WIDEST_SLOPE).all(dim=0), pixels, torch.nan), places

    def rays(self, places: Tensor) -> Tensor:
        """Points at z = 1 in the camera frame of places (2, N) on the grid, (3, N)."""
        x, y = (places[0] - self.cx) / self.fx, (places[1] - self.cy) / self.fy
        return torch.stack([x, y, torch.ones_like(x)])

    def _from_slope(self, slope: Tensor) -> Tensor:
        return torch.stack([slope[0] * self.fx + self.cx, slope[1] * self.fy + self.cy])


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Facets on a device, ready to be looked at; F facets on movers 0 (the world) to M - 1.

    Attributes:
        origin, edge_u, edge_v: (F, 3) float64, in the frame of their mover.
        triangle, closed: (F,) bool, see `Facets`.
        mover: (F,) int64.
    """

    origin: Tensor
    edge_u: Tensor
    edge_v: Tensor
    triangle: Tensor
    closed: Tensor
    mover: Tensor


class Sight:
    """What V views with the same eye see.

    Args:
        T_view_mover: (V, M, 4, 4) float64.
        near: nearest distance seen.
        only: (n,) int64 facets that there are, all unless given.
    """

    def __init__(
        self, surfaces: Surfaces, eye: Eye, T_view_mover: Tensor, near: float, only: Tensor | None = None
    ) -> None:
        self.surfaces, self.eye, self.T_view_mover, self.near = surfaces, eye, T_view_mover, near
        self._only = only
        self._count = len(surfaces.origin)

    @cached_property
    def _in_views(self) -> tuple[Tensor, Tensor, Tensor]:
        """Origins and edges of all facets in the frames of the views, (V, F, 3) each."""
        vectors = torch.stack([self.surfaces.origin, self.surfaces.edge_u, self.surfaces.edge_v])
        result = torch.empty(
            (3, len(self.T_view_mover), *vectors.shape[1:]), dtype=vectors.dtype, device=vectors.device
        )
        # One product for what stands still, which is most, and one for each that moves.
        for k in range(self.T_view_mover.shape[1]):
            target = (self.surfaces.mover == k).nonzero().squeeze(1)
            T = self.T_view_mover[:, k]
            turned = vectors[:, target].unsqueeze(1) @ T[:, :3, :3].transpose(1, 2)
            turned[0] += T[:, None, :3, 3]
            result[:, :, target] = turned
        return result[0], result[1], result[2]

    @cached_property
    def _maps(self) -> tuple[Tensor, Tensor]:
        """Nine tables of one number each (9, V F), from which gathering is fast, and n . o (V, F); see `_maps_of`."""
        maps, towards = _maps_of(*self._in_views, self.eye)
        return maps.reshape(-1, 9).T.contiguous(), towards

    @cached_property
    def facet(self) -> Tensor:
        """The facet at each place of the grid, (V, h, w) int64; -1 where there is none."""
        origin, edge_u, edge_v = self._in_views
        surfaces, (tables, towards) = self.surfaces, self._maps
        drawn = towards.abs() > 1e-9 * origin.norm(dim=-1)
        drawn &= ~surfaces.closed | (towards < 0)
        if self._only is not None:
            chosen = torch.zeros_like(surfaces.closed)
            chosen[self._only] = True
            drawn &= chosen
        view, facet = drawn.nonzero(as_tuple=True)
        triangle = surfaces.triangle
        boxes = _screen_boxes(origin[drawn], edge_u[drawn], edge_v[drawn], triangle[facet], self.eye, self.near)
        inside = ((boxes[:, 0] <= boxes[:, 1]) & (boxes[:, 2] <= boxes[:, 3])).nonzero().squeeze(1)
        view, facet, boxes = view[inside], facet[inside], boxes[inside]
        return _fill(tables, view, facet, boxes, triangle, self.eye, self.near, len(self.T_view_mover))

    def rows(self, view: Tensor, facet: Tensor) -> list[Tensor]:
        """The nine numbers of the maps from places to (a, b, 1) / z of facets (N,) in views (N,), row by row."""
        index = view * self._count + facet
        return [table.index_select(0, index) for table in self._maps[0]]

    def evaluate(self, view: Tensor, facet: Tensor, places: Tensor) -> Tensor:
        """(3, N): a / z, b / z and 1 / z of the facets' planes at places (2, N) of views (N,)."""
        return apply(self.rows(view, facet), places)

    def points(self, view: Tensor, facet: Tensor, places: Tensor) -> Tensor:
        """Points (3, N) of facets seen at places (2, N) of views (N,), in the frames of the facets' movers."""
        in_view = self.eye.rays(places) / self.evaluate(view, facet, places)[2]
        mover = self.surfaces.mover.index_select(0, facet)
        return move(torch.linalg.inv(self.T_view_mover), view, mover, in_view)

    def inside(self, facet: Tensor, values: Tensor) -> Tensor:
        """Whether the rays of `evaluate` meet the facets themselves, (N,) bool."""
        a, b, w = values
        low = -_INSIDE_TOLERANCE * w
        beyond = torch.where(self.surfaces.triangle.index_select(0, facet), a + b, torch.maximum(a, b))
        return (w > _MIN_INVERSE_DEPTH) & (torch.minimum(a, b) >= low) & (beyond <= w - 2 * low)

    def resolve(self, view: Tensor, places: Tensor) -> Tensor:
        """The facet seen at places (2, N) of views (N,), -1 for none; exact where the grid around shows it."""
        around = self._around(view, places, _NEXT)
        facet = around[0].clone()
        mixed = (around != around[0]).any(dim=0).nonzero().squeeze(1)
        nearest, best = self._nearest_met(view[mixed], around[:, mixed], places[:, mixed])
        facet[mixed] = nearest
        # Facets smaller than the grid: the next ring may have it. The open sky meets nothing.
        lost = ((best == 0) & (around[:, mixed] >= 0).any(dim=0)).nonzero().squeeze(1)
        unresolved = mixed[lost]
        wider = self._around(view[unresolved], places[:, unresolved], _RING)
        nearest, best = self._nearest_met(view[unresolved], wider, places[:, unresolved])
        sky = (around[:, unresolved] < 0).any(dim=0)
        facet[unresolved] = torch.where(
            (best > 0) | sky, nearest, self._closest(view[unresolved], places[:, unresolved])
        )
        return facet

    def hidden(self, view: Tensor, places: Tensor, inverse_depth: Tensor, target: Tensor) -> Tensor:
        """Whether another facet than `target` (N,) is nearer than 1 / inverse_depth at places (2, N), (N,) bool."""
        around = self._around(view, places, _NEXT)
        result = torch.zeros_like(target, dtype=torch.bool)
        uniform = (around == around[0]).all(dim=0)
        for kind, count in ((uniform, 1), (~uniform, 4)):
            candidates = around[:count]
            foreign = ((candidates != target) & (candidates >= 0)).any(dim=0)
            index = (kind & foreign).nonzero().squeeze(1)
            candidates, limit = candidates[:, index], inverse_depth[index]
            w, hit = self._try(view[index], candidates, places[:, index])
            met = hit & (w > (1 + _NEARER) * limit) & (candidates != target[index])
            # Facets smaller than the grid may lie between its places: then all planes around are nearer by far.
            behind = ((w > (1 + _FAR_NEARER) * limit) & (candidates >= 0)).all(dim=0)
            result[index] = met.any(dim=0) | behind
        return result

    def _nearest_met(self, view: Tensor, candidates: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Of candidates (c, N) the nearest that is met, (N,), -1 for none, and its 1 / z, 0 for none."""
        w, hit = self._try(view, candidates, places)
        best, index = torch.where(hit, w, 0.0).max(dim=0)
        chosen = candidates.gather(0, index.unsqueeze(0)).squeeze(0)
        return torch.where(best > 0, chosen, -1), best

    def _around(self, view: Tensor, places: Tensor, offsets: tuple[tuple[int, int], ...]) -> Tensor:
        """What the grid sees at offsets (u, v) from the corner of each place's cell, (c, N)."""
        height, width = self.facet.shape[1:]
        u, v = places.floor().long()
        flat = self.facet.reshape(-1)
        if offsets is _NEXT:
            first = (view * height + v.clamp(0, height - 2)) * width + u.clamp(0, width - 2)
            return torch.stack([flat.index_select(0, first + k) for k in (0, 1, width, width + 1)])
        return torch.stack(
            [
                flat[(view * height + (v + dv).clamp(0, height - 1)) * width + (u + du).clamp(0, width - 1)]
                for du, dv in offsets
            ]
        )

    def _closest(self, view: Tensor, places: Tensor) -> Tensor:
        height, width = self.facet.shape[1:]
        u, v = places.round().long()
        return self.facet[view, v.clamp(0, height - 1), u.clamp(0, width - 1)]

    def _try(self, view: Tensor, candidates: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """1 / z (c, N) of the candidates' planes, and whether the rays meet them (c, N)."""
        count = len(candidates)
        facet = candidates.clamp_min(0).reshape(-1)
        values = self.evaluate(view.repeat(count), facet, places.repeat(1, count))
        hit = self.inside(facet, values) & (candidates.reshape(-1) >= 0)
        return values[2].reshape(count, -1), hit.reshape(count, -1)


def apply(rows: list[Tensor], places: Tensor) -> Tensor:
    """Maps of nine numbers each (N,), row by row, at places (2, N): (3, N)."""
    u, v = places
    return torch.stack([torch.addcmul(torch.addcmul(rows[k + 2], rows[k], u), rows[k + 1], v) for k in (0, 3, 6)])


def move(T: Tensor, view: Tensor, mover: Tensor, points: Tensor) -> Tensor:
    """Points (3, N) under T[view, mover] out of (V, M, 4, 4)."""
    if len(T) == 1:  # one product for what stands still, which is most, and one for each that moves
        moved = T[0, 0, :3, :3] @ points + T[0, 0, :3, 3:]
        for k in range(1, T.shape[1]):
            index = (mover == k).nonzero().squeeze(1)
            moved[:, index] = T[0, k, :3, :3] @ points[:, index] + T[0, k, :3, 3:]
        return moved
    rows = T[..., :3, :].reshape(-1, 12).T.contiguous().index_select(1, view * T.shape[1] + mover)
    x, y, z = points
    return torch.stack([rows[k] * x + rows[k + 1] * y + rows[k + 2] * z + rows[k + 3] for k in (0, 4, 8)])


def _maps_of(origin: Tensor, edge_u: Tensor, edge_v: Tensor, eye: Eye) -> tuple[Tensor, Tensor]:
    """Maps (V, F, 3, 3), and n . o with n the unit normal e_u x e_v: negative where the front is seen."""
    cross = torch.linalg.cross
    normal = cross(edge_u, edge_v)
    volume = (normal * origin).sum(dim=-1, keepdim=True)
    safe = torch.where(volume.abs() < 1e-300, torch.ones_like(volume), volume)
    rows = torch.stack([cross(edge_v, origin), cross(origin, edge_u), normal], dim=-2) / safe.unsqueeze(-1)
    maps = rows @ torch.from_numpy(np.linalg.inv(eye.matrix)).to(rows)
    towards = volume.squeeze(-1) / normal.norm(dim=-1).clamp_min(1e-300)
    return maps, towards


def _screen_boxes(origin: Tensor, edge_u: Tensor, edge_v: Tensor, triangle: Tensor, eye: Eye, near: float) -> Tensor:
    """First and last column, first and last row (P, 4) of what lies beyond the near plane; empty if first > last."""
    end_u = origin + edge_u
    far = torch.where(triangle[:, None], end_u, end_u + edge_v)
    corners = torch.stack([origin, end_u, far, origin + edge_v], dim=-2)
    following = corners.roll(-1, dims=-2)
    z, next_z = corners[..., 2], following[..., 2]
    step = next_z - z
    share = (near - z) / torch.where(step.abs() < 1e-300, torch.ones_like(step), step)
    crossing = corners + share.unsqueeze(-1) * (following - corners)
    points = torch.cat([corners, crossing], dim=-2)
    kept = torch.cat([z >= near, (z < near) != (next_z < near)], dim=-1)
    depth = points[..., 2].clamp_min(0.5 * near)
    bounds = []
    for axis, focal, centre, last in ((0, eye.fx, eye.cx, eye.width - 1), (1, eye.fy, eye.cy, eye.height - 1)):
        place = focal * points[..., axis] / depth + centre
        low = torch.where(kept, place, torch.inf).amin(dim=-1)
        high = torch.where(kept, place, -torch.inf).amax(dim=-1)
        bounds += [(low - _SPAN_TOLERANCE).ceil().clamp(0, last + 1), (high + _SPAN_TOLERANCE).floor().clamp(-1, last)]
    return torch.stack(bounds, dim=-1).long()


def _fill(
    tables: Tensor, view: Tensor, facet: Tensor, boxes: Tensor, triangle: Tensor, eye: Eye, near: float, views: int
) -> Tensor:
    """The nearest facet (V, h, w) at each place, from P drawn pairs of view and facet with their boxes (P, 4)."""
    width, height = eye.width, eye.height
    nearest = torch.zeros(views * height * width, dtype=torch.int64, device=view.device)
    a, b, w = tables.index_select(1, view * (tables.shape[1] // views) + facet).T.reshape(-1, 3, 3).unbind(dim=1)
    # Each row (p, q, r) is an inequality p u + q v + r >= 0.
    is_triangle = triangle[facet].unsqueeze(1)
    nearer_than = -w
    nearer_than[:, 2] += 1.0 / near
    sides = torch.stack(
        [a, b, torch.where(is_triangle, w - a - b, w - a), torch.where(is_triangle, w - a - b, w - b), nearer_than], 1
    )
    rows = boxes[:, 3] - boxes[:, 2] + 1
    owner, row = _enumerate(rows)
    row = row + boxes[owner, 2]
    slope = sides[owner, :, 0]
    base = sides[owner, :, 1] * row.unsqueeze(1) + sides[owner, :, 2]
    bound = -base / torch.where(slope == 0, torch.ones_like(slope), slope)
    low = torch.where(slope > 0, bound, -torch.inf).amax(dim=1)
    high = torch.where(slope < 0, bound, torch.inf).amin(dim=1)
    empty = ((slope == 0) & (base < 0)).any(dim=1)
    first = torch.maximum((low - _SPAN_TOLERANCE).ceil(), boxes[owner, 0])
    last = torch.minimum((high + _SPAN_TOLERANCE).floor(), boxes[owner, 1])
    filled = (~empty & (first <= last)).nonzero().squeeze(1)
    owner, row, first = owner[filled], row[filled], first[filled].long()
    counts = last[filled].long() - first + 1

    pixels = (view[owner] * height + row) * width + first
    slopes = w[owner, 0]
    bases = slopes * first + w[owner, 1] * row + w[owner, 2]
    facets = facet[owner]
    ends = counts.cumsum(0)
    starts = ends - counts
    total = int(ends[-1]) if len(ends) else 0
    for begin in range(0, total, _FRAGMENTS):
        # Whole spans; one is never as long as a chunk.
        part = slice(*(int(torch.searchsorted(ends, begin + k, right=True)) for k in (0, _FRAGMENTS)))
        chunk = counts[part]
        span = torch.repeat_interleave(torch.arange(len(chunk), device=chunk.device), chunk)
        number = torch.arange(len(span), device=chunk.device)
        # With the spans' starts taken off beforehand, the running number serves as the step within each.
        offset = starts[part] - starts[part][0] if len(chunk) else starts[part]
        pixel = (pixels[part] - offset).index_select(0, span) + number
        slope = slopes[part]
        inverse_depth = (bases[part] - slope * offset).index_select(0, span)
        inverse_depth.addcmul_(slope.index_select(0, span), number)
        # Positive floats order like their bits; of equals the facet with the larger index wins.
        key = (inverse_depth.float().view(torch.int32).long() << 32) | facets[part].index_select(0, span)
        nearest.scatter_reduce_(0, pixel, key, "amax")
    result = torch.where(nearest > 0, nearest & 0xFFFFFFFF, -1)
    return result.reshape(views, height, width)


def _enumerate(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts (n,): the owner and the running number within the owner of each of their sum's items."""
    owner = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    starts = counts.cumsum(0) - counts
    return owner, torch.arange(len(owner), device=counts.device) - starts[owner]

"""Textured planar rectangles, ray cast per pixel: an image with exact depth.

A rectangle with corner o and edges e_u, e_v, all in the camera frame, holds the points o + a e_u + b e_v with
a, b in [0, 1]. Seen from pixel (u, v) with calibration K this is one 3x3 map,
(a, b, 1) / z = [e_u e_v o]^-1 K^-1 (u, v, 1), which gives place, depth and their derivatives in closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

NEAR = 0.02  # metres; nothing closer than this is drawn
CHUNK = 1 << 15  # rays sampled at a time


@dataclass(frozen=True, slots=True)
class Pinhole:
    """An ideal camera; pixel (0, 0) is the centre of the top-left pixel."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) calibration matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A textured rectangle, visible from both sides.

    Attributes:
        origin: (3,) corner where the texture's top-left pixel lies, world frame, metres.
        edge_u, edge_v: (3,) edges along the texture's columns and rows.
        texture: (h, w) grey values, uint8 or float in [0, 1]. A texture smaller than the rectangle is
            repeated by mirroring, so that it has no seams.
        pixels_per_metre: scale of the texture.
    """

    origin: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    texture: np.ndarray
    pixels_per_metre: float


class Rendering(NamedTuple):
    """What a camera sees.

    Attributes:
        image: (H, W) float32 in [0, 1], area-filtered.
        depth: (H, W) float64 z-depth along the ray of the pixel's centre, metres; inf where it meets nothing.
        rectangle: (H, W) int32 index into `Scene.rectangles`; -1 where the ray meets nothing.
    """

    image: np.ndarray
    depth: np.ndarray
    rectangle: np.ndarray


class Scene:
    """Rectangles with their mip-mapped textures.

    Args:
        rectangles: at least one.
        sky: grey value in [0, 1] where a ray meets nothing.
    """

    def __init__(self, rectangles: Sequence[Rectangle], sky: float = 0.8) -> None:
        self.rectangles = tuple(rectangles)
        self.sky = sky
        self.origins = np.array([r.origin for r in rectangles], dtype=np.float64)
        self.edges_u = np.array([r.edge_u for r in rectangles], dtype=np.float64)
        self.edges_v = np.array([r.edge_v for r in rectangles], dtype=np.float64)
        pyramids: dict[int, int] = {}
        levels: list[list[np.ndarray]] = []
        for r in rectangles:
            if id(r.texture) not in pyramids:
                pyramids[id(r.texture)] = len(levels)
                levels.append(_mip_levels(r.texture))
        owner = np.array([pyramids[id(r.texture)] for r in rectangles])
        # All levels of all textures lie in one flat array, so that one gather serves the whole image.
        self.level_count = np.array([len(pyramid) for pyramid in levels])[owner]
        deepest = int(self.level_count.max())
        sizes = np.ones((len(levels), deepest, 2), dtype=np.int32)
        starts = np.zeros((len(levels), deepest), dtype=np.int64)
        position = 0
        for i, pyramid in enumerate(levels):
            for j, level in enumerate(pyramid):
                sizes[i, j], starts[i, j] = level.shape, position
                position += level.size
        self.texels = np.concatenate([level.ravel() for pyramid in levels for level in pyramid])
        # (N, levels): size of each level, its share of the full size, and where it begins in `texels`.
        self.level_heights, self.level_widths = sizes[owner, :, 0], sizes[owner, :, 1]
        self.level_shrinks_v = self.level_heights / self.level_heights[:, :1]
        self.level_shrinks_u = self.level_widths / self.level_widths[:, :1]
        self.level_starts = starts[owner]
        scale = np.array([r.pixels_per_metre for r in rectangles], dtype=np.float64)
        # (N, 2): texture pixels along the whole of edge_u and of edge_v.
        self.texture_extent = scale[:, None] * np.stack(
            [np.linalg.norm(self.edges_u, axis=1), np.linalg.norm(self.edges_v, axis=1)], axis=1
        )


def render(scene: Scene, camera: Pinhole, T_world_camera: np.ndarray, supersample: int = 2, taps: int = 3) -> Rendering:
    """Draw a scene.

    Args:
        scene: what to draw.
        camera: intrinsics and size.
        T_world_camera: (4, 4) pose of the camera, x right, y down, z forward.
        supersample: each pixel's grey value is the mean over supersample x supersample rays.
        taps: texture look-ups per ray along the longer axis of its footprint (anisotropic filtering).
    """
    centre = _cast(scene, camera, T_world_camera)
    s = supersample
    fine = Pinhole(
        s * camera.fx,
        s * camera.fy,
        s * (camera.cx + 0.5) - 0.5,
        s * (camera.cy + 0.5) - 0.5,
        s * camera.width,
        s * camera.height,
    )
    rays = _cast(scene, fine, T_world_camera)
    hit = rays.rectangle >= 0
    grey = np.full(hit.shape, scene.sky, dtype=np.float32)
    grey[hit] = _sample(scene, rays, hit, taps)
    image = grey.reshape(camera.height, s, camera.width, s).mean(axis=(1, 3), dtype=np.float32)
    with np.errstate(divide="ignore"):
        depth = 1.0 / centre.inverse_depth
    return Rendering(image, depth, centre.rectangle)


class _Rays(NamedTuple):
    maps: np.ndarray  # (N, 3, 3) pixel (u, v, 1) -> (a, b, 1) / z
    inverse_depth: np.ndarray  # (H, W)
    rectangle: np.ndarray  # (H, W)


def _cast(scene: Scene, camera: Pinhole, T_world_camera: np.ndarray) -> _Rays:
    """The nearest rectangle at each pixel's centre."""
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    origins, edges_u, edges_v = (scene.origins - t) @ R, scene.edges_u @ R, scene.edges_v @ R
    frames = np.stack([edges_u, edges_v, origins], axis=-1)
    volume = np.abs(np.linalg.det(frames))
    area = np.linalg.norm(np.cross(edges_u, edges_v), axis=-1)
    edge_on = volume < 1e-9 * area  # the camera's centre lies in the plane: the rectangle is a line
    frames[edge_on] = np.eye(3)
    maps = np.linalg.inv(frames) @ np.linalg.inv(camera.matrix)

    inverse_depth = np.zeros((camera.height, camera.width))
    rectangle = np.full((camera.height, camera.width), -1, dtype=np.int32)
    for i in np.flatnonzero(~edge_on):
        corners = origins[i] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ np.stack([edges_u[i], edges_v[i]])
        box = _screen_box(corners, camera)
        if box is None:
            continue
        rows, columns = box
        v = np.arange(rows.start, rows.stop)[:, None]
        u = np.arange(columns.start, columns.stop)[None, :]
        a, b, w = (m[0] * u + (m[1] * v + m[2]) for m in maps[i])
        # a and b still carry the factor w = 1/z, so that the test is a, b in [0, w].
        nearer = (a >= 0) & (a <= w) & (b >= 0) & (b <= w) & (w > inverse_depth[box]) & (w < 1 / NEAR)
        inverse_depth[box][nearer] = w[nearer]
        rectangle[box][nearer] = i
    return _Rays(maps, inverse_depth, rectangle)


def _screen_box(corners: np.ndarray, camera: Pinhole) -> tuple[slice, slice] | None:
    """Rows and columns of the part of a convex polygon (4, 3) in front of the camera; None if empty."""
    following = np.roll(corners, -1, axis=0)
    crossing = (corners[:, 2] < NEAR) != (following[:, 2] < NEAR)
    start, stop = corners[crossing], following[crossing]
    share = (NEAR - start[:, 2:]) / (stop[:, 2:] - start[:, 2:])
    visible = np.concatenate([corners[corners[:, 2] >= NEAR], start + share * (stop - start)])
    if not len(visible):
        return None
    u = camera.fx * visible[:, 0] / visible[:, 2] + camera.cx
    v = camera.fy * visible[:, 1] / visible[:, 2] + camera.cy
    left, right = max(0, int(np.floor(u.min()))), min(camera.width, int(np.ceil(u.max())) + 1)
    top, bottom = max(0, int(np.floor(v.min()))), min(camera.height, int(np.ceil(v.max())) + 1)
    return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def _sample(scene: Scene, rays: _Rays, hit: np.ndarray, taps: int) -> np.ndarray:
    """Grey values (n,) of the rays that hit, filtered over each ray's footprint in its texture."""
    rows, columns = np.nonzero(hit)
    index = rays.rectangle[hit]
    depth = 1.0 / rays.inverse_depth[hit]
    grey = np.empty(len(index), dtype=np.float32)
    for start in range(0, len(index), CHUNK):  # what one chunk needs stays in the processor's cache
        part = slice(start, start + CHUNK)
        grey[part] = _look_up(scene, rays.maps, index[part], columns[part], rows[part], depth[part], taps)
    return grey


def _look_up(
    scene: Scene, maps: np.ndarray, index: np.ndarray, u: np.ndarray, v: np.ndarray, z: np.ndarray, taps: int
) -> np.ndarray:
    m = maps[index]
    # Texture coordinates (in pixels, 0 at the edge of the texture) and their derivatives along u and v.
    place = []
    slope = []
    for axis in (0, 1):
        extent = scene.texture_extent[index, axis]
        fraction = (m[:, axis, 0] * u + m[:, axis, 1] * v + m[:, axis, 2]) * z
        place.append(fraction * extent)
        scaled = z * extent
        slope.append([(m[:, axis, k] - fraction * m[:, 2, k]) * scaled for k in (0, 1)])
    (xu, xv), (yu, yv) = slope
    # The footprint is an ellipse: its axes are the singular values of the Jacobian.
    sum_x, sum_y, cross = xu**2 + xv**2, yu**2 + yv**2, xu * yu + xv * yv
    spread = np.hypot(sum_x - sum_y, 2 * cross)
    major, minor = np.sqrt((sum_x + sum_y + spread) / 2), np.sqrt(np.abs(sum_x + sum_y - spread) / 2)
    angle = np.arctan2(2 * cross, sum_x - sum_y) / 2
    stretched = major > 1.2 * np.maximum(minor, 1.0)
    grey = np.empty(len(index), dtype=np.float32)
    for group, count in ((stretched, taps), (~stretched, 1)):
        i, long = index[group], major[group]
        step_x, step_y = long * np.cos(angle[group]), long * np.sin(angle[group])
        top_level = scene.level_count[i] - 1
        blur = np.log2(np.maximum(np.maximum(minor[group], long / count), 1.0))
        blur = np.minimum(blur, top_level)
        level = blur.astype(np.int32)
        between = (blur - level).astype(np.float32)
        total = np.zeros(len(i), dtype=np.float32)
        for k in range(count):
            offset = (k + 0.5) / count - 0.5
            x, y = place[0][group] + offset * step_x, place[1][group] + offset * step_y
            total += (1 - between) * _bilinear(scene, i, level, x, y)
            total += between * _bilinear(scene, i, np.minimum(level + 1, top_level), x, y)
        grey[group] = total / count
    return grey


def _bilinear(scene: Scene, index: np.ndarray, level: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey values of one mip level at full-size texture coordinates x, y (n,)."""
    height, width = scene.level_heights[index, level], scene.level_widths[index, level]
    x = x * scene.level_shrinks_u[index, level] - 0.5
    y = y * scene.level_shrinks_v[index, level] - 0.5
    column, row = np.floor(x), np.floor(y)
    p, q = (x - column).astype(np.float32), (y - row).astype(np.float32)
    column, row = column.astype(np.int32), row.astype(np.int32)
    left, right = _mirror(column, width), _mirror(column + 1, width)
    start = scene.level_starts[index, level]
    top = start + _mirror(row, height) * width
    bottom = start + _mirror(row + 1, height) * width
    texels = scene.texels
    upper = (1 - p) * texels[top + left] + p * texels[top + right]
    lower = (1 - p) * texels[bottom + left] + p * texels[bottom + right]
    result: np.ndarray = (1 - q) * upper + q * lower
    return result


def _mirror(position: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Indices folded into [0, size) by reflection at both ends, as often as needed."""
    if (position >= 2 * size).any() or (position < -size).any():
        position = np.mod(position, 2 * size)
    position = np.maximum(position, -1 - position)
    return np.asarray(np.minimum(position, 2 * size - 1 - position))


def _mip_levels(texture: np.ndarray) -> list[np.ndarray]:
    """The texture as float32 in [0, 1] and its area-averaged halvings, down to a few pixels."""
    level = np.float32(1.0 / 255.0 if texture.dtype == np.uint8 else 1.0) * texture.astype(np.float32)
    levels = [level]
    while min(level.shape) > 3:
        half = (level.shape[1] // 2, level.shape[0] // 2)
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), dtype=np.float32)
        levels.append(level)
    return levels

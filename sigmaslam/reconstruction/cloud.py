"""Points with covariances: from depths of keyframes, merged in voxels, and as a PLY file."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np

from sigmaslam.files import write_ply
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import skew, transform_points
from sigmaslam.reconstruction.disparity import kernels
from sigmaslam.table import Table

# Rows and columns of the six numbers of a symmetric matrix.
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
# Pixels are exact to half of one: a point is anywhere in its square.
_PIXEL_VARIANCE = 1.0 / 12.0
# What a small step of the camera, translation before rotation, moves a point by: linear in 1, x, y and z.
_BY_POSE = np.concatenate([np.eye(3, 6)[None], [np.hstack([np.zeros((3, 3)), -skew(axis)]) for axis in np.eye(3)]])
# One number for the four of a voxel: different ones of voxels fewer than half a million apart, and of all levels.
_ONE_KEY = np.array([1, 1 << 19, 1 << 38, 1 << 57])
_MOST_LEVEL = 15
# Sigma is along the ray: across it points are known to a pixel, and voxels of a sigma would leave gaps to see through.
_SIGMA_SHARE = 0.125
_COVARIANCE_NAMES = tuple(f"covariance_{'xyz'[a]}{'xyz'[b]}" for a, b in zip(_ROWS, _COLUMNS, strict=True))


@dataclass(frozen=True, slots=True)
class DenseCloud(Table):
    """Points of surfaces.

    Attributes:
        points: (N, 3) in the world, metres.
        covariances: (N, 6) of them, float32: xx, xy, xz, yy, yz, zz, metres squared.
        colours: (N, 3) float32 red, green and blue, 0 to 255; equal where images are grey.
        views: (N,) int32 depths of keyframes that were merged into the point.
    """

    points: np.ndarray
    covariances: np.ndarray
    colours: np.ndarray
    views: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(N,) root of the largest eigenvalue of the covariance, metres."""
        return np.sqrt(np.maximum(largest_eigenvalue(self.covariances.astype(np.float64)), 0.0)).astype(np.float32)


def inverse(six: np.ndarray) -> np.ndarray:
    """The six numbers (..., 6) of the inverses of positive definite matrices of such, from their cofactors."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(six, -1, 0)
    cofactors = (
        yy * zz - yz * yz,
        xz * yz - xy * zz,
        xy * yz - xz * yy,
        xx * zz - xz * xz,
        xy * xz - xx * yz,
        xx * yy - xy * xy,
    )
    determinant = xx * cofactors[0] + xy * cofactors[1] + xz * cofactors[2]
    return np.stack(cofactors, axis=-1) / determinant[..., None]


def largest_eigenvalue(six: np.ndarray) -> np.ndarray:
    """(...) of symmetric matrices of such numbers (..., 6): the trigonometric root of their characteristic equation."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(six, -1, 0)
    mean = (xx + yy + zz) / 3.0
    x, y, z = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((x * x + y * y + z * z + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    determinant = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.where(spread > 0.0, determinant / (2.0 * spread**3), 1.0)
    return np.asarray(mean + 2.0 * spread * np.cos(np.arccos(np.clip(cosine, -1.0, 1.0)) / 3.0))


@dataclass(frozen=True, slots=True)
class DepthPixels(Table):
    """Pixels of a keyframe with a depth.

    Attributes:
        pixels: (N, 2) int64 (u, v).
        disparity: (N,) inverse depth times focal length and baseline, pixels.
        variance: (N,) of it, pixels squared.
        colours: (N, 3) uint8 red, green and blue.
    """

    pixels: np.ndarray
    disparity: np.ndarray
    variance: np.ndarray
    colours: np.ndarray

    @classmethod
    def of(cls, disparity: np.ndarray, variance: np.ndarray, picture: np.ndarray, chosen: np.ndarray) -> Self:
        """The chosen pixels, (H, W) bool, of such images (H, W), the picture (H, W, 3); disparities are positive."""
        values, variances = (each[chosen].astype(float) for each in (disparity, variance))
        return cls(np.argwhere(chosen)[:, ::-1], values, variances, picture[chosen])

    def points(self, camera: RectifiedStereo) -> np.ndarray:
        """(N, 3) in the rectified left camera, metres."""
        return camera.triangulate(np.column_stack([self.pixels, self.disparity]))

    def sigma(self, camera: RectifiedStereo) -> np.ndarray:
        """(N,) standard deviation along the ray, metres."""
        return np.asarray(np.linalg.norm(self.points(camera), axis=1) * np.sqrt(self.variance) / self.disparity)

    def cloud(self, camera: RectifiedStereo, pose: np.ndarray, pose_covariance: np.ndarray) -> DenseCloud:
        """Points in the world.

        Args:
            pose, pose_covariance: (4, 4) T_world_rectified and its covariance (6, 6) in the rectified camera's frame,
                translation (metres) before rotation (radians).
        """
        points = self.points(camera)
        rotation = pose[:3, :3]
        # (9.35): along the ray by the disparity, across it by the pixel, and with the camera, quadratic in the point.
        along = points @ rotation.T / self.disparity[:, None]
        across = points[:, 2] ** 2 * (_PIXEL_VARIANCE / camera.fx**2)
        terms = np.column_stack([np.ones(len(points)), points])
        levers = rotation @ _BY_POSE
        factors = np.einsum("mik,kl,njl->mnij", levers, pose_covariance, levers)[..., _ROWS, _COLUMNS]
        covariances = (terms[:, :, None] * terms[:, None]).reshape(-1, 16) @ factors.reshape(16, 6)
        covariances += self.variance[:, None] * along[:, _ROWS] * along[:, _COLUMNS]
        covariances += across[:, None] * (rotation[:, :2] @ rotation[:, :2].T)[_ROWS, _COLUMNS]
        return DenseCloud(
            transform_points(pose, points),
            covariances.astype(np.float32),
            self.colours.astype(np.float32),
            np.ones(len(points), np.int32),
        )

    def thinned(self, camera: RectifiedStereo, size: float) -> Self:
        """The most certain pixel of each voxel of the camera's frame; those beside it have nearly the same errors."""
        if kernels is not None:
            pair = camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline
            numbers = pair, size, _SIGMA_SHARE, _MOST_LEVEL
            return self.select(kernels.thin(self.pixels, self.disparity, self.variance, *numbers))
        order, first = _groups(_voxels(self.points(camera), self.sigma(camera), size) @ _ONE_KEY)
        relative = (self.variance / self.disparity**2)[order]
        best = relative == np.repeat(np.minimum.reduceat(relative, first), np.diff(np.r_[first, len(order)]))
        return self.select(np.sort(np.minimum.reduceat(np.where(best, order, len(order)), first)))


class VoxelCloud:
    """Points that come keyframe by keyframe, one kept per voxel.

    A voxel's side is doubled until it is an eighth of the point's sigma or more, but for the pose's, which all share.
    Points of different sides lie in different voxels; of those the finer ones stay.

    What falls into a voxel has errors in common, of poses and of texture, in a degree that is not known. Covariance
    intersection with equal weights is consistent whatever it is: the mean of the information, and the mean weighted by
    it.

    Memory is bounded until `cloud` is asked for: when there are more voxels than that they are written to a temporary
    folder, and others begin.

    Args:
        size: of the finest voxel, metres.
        most: voxels in memory, of 126 bytes.
    """

    def __init__(self, size: float, most: int = 2_000_000) -> None:
        self.size = size
        self._most, self._folder, self._written = most, TemporaryDirectory(), list[Path]()
        self._voxels = self._empty()

    def _empty(self) -> Any:
        return (Voxels if kernels is None else kernels.Voxels)(self.size, _SIGMA_SHARE, _MOST_LEVEL)

    def add(self, cloud: DenseCloud, sigma: np.ndarray) -> None:
        """Takes the points of a keyframe, and their sigmas (N,) without the pose's, metres."""
        self._voxels.add(cloud.points, cloud.covariances, sigma, cloud.colours, cloud.views)
        if len(self._voxels) > self._most:
            self._written.append(Path(self._folder.name) / f"{len(self._written)}.npz")
            np.savez(self._written[-1], *self._voxels.rows(0))
            self._voxels = self._empty()

    def cloud(self, min_views: int = 1) -> DenseCloud:
        """The points that so many keyframes gave, or more, without those in whose voxels there are finer ones."""
        for path in self._written:
            with np.load(path) as parts:
                self._voxels.merge(*(parts[f"arr_{k}"] for k in range(3)))
        self._written = []
        keys, levels, sums = self._voxels.rows(min_views)
        order = np.argsort(keys)
        keys, levels, sums = keys[order], levels[order], sums[order]
        information, count = sums[:, :6], sums[:, 12]
        covariance = inverse(information)
        points = _product(covariance, sums[:, 6:9])
        finest = np.ones(len(keys), bool)
        for level in range(1, int(levels.max(initial=0)) + 1):
            here = levels == level
            finer = _at_level(points[levels < level], level, self.size)
            finest[here] = ~np.isin(keys[here], finer @ _ONE_KEY)
        return DenseCloud(
            points,
            (covariance * count[:, None]).astype(np.float32),
            (sums[:, 9:12] / count[:, None]).astype(np.float32),
            count.astype(np.int32),
        ).select(finest)


class Voxels:
    """Sums of what falls into each voxel: the twin of the compiled class.

    Args:
        size: of the finest voxel, metres.
        share: of a point's sigma that its voxel's side must have.
        most_level: how often a side is doubled at the most.
    """

    def __init__(self, size: float, share: float, most_level: int) -> None:
        assert (share, most_level) == (_SIGMA_SHARE, _MOST_LEVEL)
        self._size, self._rows = size, (np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros((0, 13)))

    def __len__(self) -> int:
        return len(self._rows[0])

    def add(self, points: np.ndarray, covariances: np.ndarray, sigma: np.ndarray, *seen: np.ndarray) -> None:
        """Takes points (N, 3), covariances (N, 6), sigmas without the pose's, colours (N, 3), views (N,)."""
        information, (colours, views) = inverse(covariances.astype(np.float64)), seen
        sums = np.column_stack([information, _product(information, points), colours * views[:, None], views])
        cells = _voxels(points, sigma, self._size)
        self.merge(cells @ _ONE_KEY, cells[:, 3].astype(np.uint8), sums)

    def merge(self, *rows: np.ndarray) -> None:
        """Takes rows as `rows` gives them."""
        keys, levels, sums = (np.concatenate([self._rows[k], rows[k]]) for k in range(3))
        order, first = _groups(keys)
        total = np.add.reduceat(sums[order], first) if len(keys) else sums
        self._rows = keys[order[first]], levels[order[first]], total

    def rows(self, min_views: int) -> tuple[np.ndarray, ...]:
        """Packed voxels and their levels (M,), and (M, 13) sums of information, that times points, colours and
        views, of those that so many views or more gave."""
        seen = self._rows[2][:, 12] >= min_views
        return tuple(each[seen] for each in self._rows)


def _voxels(points: np.ndarray, sigma: np.ndarray, size: float) -> np.ndarray:
    """(N, 4) voxels of points with such sigmas: coordinates and how often the side was doubled."""
    level = np.ceil(np.log2(np.maximum(_SIGMA_SHARE * sigma / size, 1.0))).clip(0, _MOST_LEVEL).astype(np.int64)
    return _at_level(points, level, size)


def _at_level(points: np.ndarray, level: np.ndarray | int, size: float) -> np.ndarray:
    """(N, 4) voxels of points at a level, or at one each."""
    cells = np.empty((len(points), 4), np.int64)
    cells[:, 3] = level
    cells[:, :3] = np.floor(points * np.ldexp(1.0 / size, -cells[:, 3:]))
    return cells


def write_cloud(path: Path, cloud: DenseCloud) -> None:
    """A binary PLY: x, y, z, red, green, blue, sigma, six numbers of the covariance, and views."""
    columns = {name: ("float", cloud.points[:, axis]) for axis, name in enumerate("xyz")}
    colours = np.clip(np.rint(cloud.colours), 0, 255)
    columns |= {name: ("uchar", colours[:, k]) for k, name in enumerate(("red", "green", "blue"))}
    columns["sigma"] = ("float", cloud.sigma)
    columns |= {name: ("float", cloud.covariances[:, k]) for k, name in enumerate(_COVARIANCE_NAMES)}
    columns["views"] = ("int", cloud.views)
    write_ply(path, columns)


def _product(six: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Products (N, 3) of symmetric matrices of such numbers (N, 6) and vectors (N, 3)."""
    xx, xy, xz, yy, yz, zz = six.T
    x, y, z = vectors.T
    return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], axis=-1)


def _groups(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) order that sorts keys (N,), and where in it those of each value begin."""
    order = np.argsort(keys)
    found = keys[order]
    return order, np.flatnonzero(np.r_[np.ones(min(len(keys), 1), bool), found[1:] != found[:-1]])

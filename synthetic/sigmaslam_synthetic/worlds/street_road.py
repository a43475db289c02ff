"""The ground of a street: heights that follow a drive, and which places are free."""

import math

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial import cKDTree

from sigmaslam_synthetic.geometry import arc_length
from sigmaslam_synthetic.motion.paths import noise
from sigmaslam_synthetic.motion.random_motions import CAMERA_HEIGHT
from sigmaslam_synthetic.rendering.shapes import Panel, Terrain
from sigmaslam_synthetic.scene import Body

_STEP = 0.5  # metres between points of the lane
_CELL = 6.0  # metres between grid lines of the ground
_BLOCK = 4  # cells along either side of a piece of ground
_REACH = 50.0  # metres from the lane to the end of the fine ground
_MARGIN = 150.0  # metres around the drive that the grids cover


class Road:
    """A lane along a drive, the ground around it, and what stands on it.

    Args:
        way: (N, 3) places of the camera, in order, metres; those that stand still may repeat.
        closed: whether it ends at its start.
        opposite: distance to the left of the middle of the oncoming lane, 0 if there is none, metres.

    Attributes:
        points: (M, 2) middle of the driven lane, before and beyond the drive too, `_STEP` apart.
        heading: (M,) radians from x towards y.
        length: metres of the lane with what lies before and beyond.
        before: metres of lane before the drive.
    """

    def __init__(self, rng: np.random.Generator, way: np.ndarray, closed: bool, opposite: float) -> None:
        way = way[np.append(True, np.linalg.norm(np.diff(way, axis=0), axis=1) > 1e-6)]
        arc = arc_length(way[:, :2])
        s = np.linspace(0.0, arc[-1], max(2, int(arc[-1] / _STEP) + 1))
        points = np.stack([np.interp(s, arc, way[:, k]) for k in range(3)], axis=-1)
        if closed:
            count = int(45 / _STEP)
            pieces = [points[-count - 1 : -1], points, points[1 : count + 1]]
        else:
            count = int(75 / _STEP)
            ahead = np.arange(1, count + 1)[:, None] * _STEP
            reach = min(6, len(points) - 1)
            first, last = points[reach] - points[0], points[-1] - points[-1 - reach]
            pieces = [points[0] - ahead[::-1] * _flat_unit(first), points, points[-1] + ahead * _flat_unit(last)]
        self.before = len(pieces[0]) * _STEP
        lane = np.concatenate(pieces)
        self.points = lane[:, :2]
        tangent = np.gradient(self.points, axis=0)
        self.heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        self.length = (len(lane) - 1) * _STEP
        self.opposite = opposite
        lanes = [self.points]
        if opposite:
            lanes.append(self.points + opposite * self._left(self.heading))
        self._lanes = cKDTree(np.concatenate(lanes))
        self._tree = cKDTree(self.points)
        self._low = np.floor((self.points.min(axis=0) - _MARGIN) / (_CELL * _BLOCK)) * _CELL * _BLOCK
        self._cells = (np.ceil((self.points.max(axis=0) + _MARGIN - self._low) / (_CELL * _BLOCK))).astype(int) * _BLOCK
        self._heights = self._make_heights(rng, lane)
        self._spline = spline_filter(self._heights, order=3, mode="mirror")
        self._taken = np.zeros((self._cells * int(_CELL)).astype(int), dtype=bool)

    def at(self, s: float | np.ndarray, left: float | np.ndarray = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Places (..., 2) and headings (...,) at s metres along the lane, and that far to its left."""
        s, left = np.asarray(s, dtype=np.float64), np.asarray(left, dtype=np.float64)
        inside = np.minimum(np.maximum(s, 0.0), self.length)
        k = np.minimum((inside / _STEP).astype(int), len(self.points) - 2)
        share = inside / _STEP - k
        place = self.points[k] + share[..., None] * (self.points[k + 1] - self.points[k])
        heading = self.heading[k] + share * (self.heading[k + 1] - self.heading[k])
        c, n = np.cos(heading)[..., None], np.sin(heading)[..., None]
        beyond, aside = (s - inside)[..., None], left[..., None]
        return place + np.concatenate([beyond * c - aside * n, beyond * n + aside * c], axis=-1), heading

    def arc_of(self, positions: np.ndarray) -> np.ndarray:
        """Metres along the lane of places (N, 3) of the drive, which go along it in order."""
        step = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
        # Of the places that a loop passes twice, the one on the drive itself.
        first = round(self.before / _STEP)
        start = (first + np.linalg.norm(self.points[first:] - positions[0, :2], axis=1).argmin()) * _STEP
        return np.asarray(start + np.concatenate([[0.0], np.cumsum(step)]))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Metres (N,) from places (N, 2) to the middle of the nearest lane."""
        return np.asarray(self._lanes.query(points)[0])

    def ground(self, points: np.ndarray) -> np.ndarray:
        """Height (N,) of the ground's facets at places (N, 2)."""
        place = np.clip((points - self._low) / _CELL, 0, self._cells - 1e-9)
        i, j = np.minimum(place.astype(int), self._cells - 1).T
        a, b = (place - np.stack([i, j], axis=-1)).T
        h = self._heights
        h00, h10, h01, h11 = h[i, j], h[i + 1, j], h[i, j + 1], h[i + 1, j + 1]
        near = h00 + a * (h10 - h00) + b * (h01 - h00)
        far = h11 + (1 - a) * (h01 - h11) + (1 - b) * (h10 - h11)
        return np.asarray(np.where(a + b <= 1, near, far))

    def smooth_ground(self, points: np.ndarray) -> np.ndarray:
        """Height (N,) of a twice differentiable surface close to the facets, at places (N, 2)."""
        return np.asarray(
            map_coordinates(self._spline, ((points - self._low) / _CELL).T, order=3, mode="mirror", prefilter=False)
        )

    def pose(self, place: np.ndarray, yaw: float, length: float = 2.0, above: float = 0.0) -> np.ndarray:
        """T_world_thing (4, 4) of a thing that stands at a place (2,), tilted with the slope along its length."""
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        rear, middle, front = self.ground(place + 0.5 * length * np.array([-1.0, 0.0, 1.0])[:, None] * ahead)
        cy, sy = float(ahead[0]), float(ahead[1])
        run = math.hypot(length, front - rear)
        cp, sp = length / run, (front - rear) / run
        z = max(middle, 0.5 * (rear + front)) + above
        return np.array(
            [
                [cy * cp, -sy, -cy * sp, place[0]],
                [sy * cp, cy, -sy * sp, place[1]],
                [sp, 0.0, cp, z],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )

    def claim(self, footprint: np.ndarray, clearance: float) -> bool:
        """Takes the places of a footprint (N, 2) if they are free and at least `clearance` from any lane's middle."""
        if self.distance(footprint).min() < clearance:
            return False
        cells = np.clip((footprint - self._low).astype(int), 0, np.array(self._taken.shape) - 1)
        if self._taken[cells[:, 0], cells[:, 1]].any():
            return False
        self._taken[cells[:, 0], cells[:, 1]] = True
        return True

    def terrain(self, road: int, land: int) -> list[Body]:
        """The ground near the lane in pieces, and a plain below the rest.

        Args:
            road, land: materials of pieces at the lane and farther off.
        """
        side = _CELL * _BLOCK
        blocks = self._cells // _BLOCK
        index = np.stack(np.meshgrid(*(np.arange(n) for n in blocks), indexing="ij"), axis=-1).reshape(-1, 2)
        distance = self._tree.query(self._low + side * (index + 0.5))[0]
        bodies = []
        for (i, j), away in zip(index[distance < _REACH], distance[distance < _REACH], strict=True):
            rows, columns = slice(i * _BLOCK, (i + 1) * _BLOCK + 1), slice(j * _BLOCK, (j + 1) * _BLOCK + 1)
            x = self._low[0] + _CELL * np.arange(rows.start, rows.stop)
            y = self._low[1] + _CELL * np.arange(columns.start, columns.stop)
            shape = Terrain(
                tuple(x.tolist()), tuple(y.tolist()), tuple(map(tuple, self._heights[rows, columns].tolist()))
            )
            bodies.append(Body(shape, road if away < 0.75 * side + 6 else land, shadow=False))
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        size = float((high - low).max()) + 1600.0
        deepest = float(self._heights.min()) - 0.7
        bodies.append(Body(Panel(size, size), land, (*(0.5 * (low + high)).tolist(), deepest), shadow=False))
        return bodies

    def _make_heights(self, rng: np.random.Generator, lane: np.ndarray) -> np.ndarray:
        """Heights at the grid lines: means over the lane nearby, rolling off the lane."""
        shape = self._cells + 1
        i, j = np.round((lane[:, :2] - self._low) / _CELL).astype(int).T
        weight, height = np.zeros(shape), np.zeros(shape)
        np.add.at(weight, (i, j), 1.0)
        np.add.at(height, (i, j), lane[:, 2] - CAMERA_HEIGHT)
        total, mean = np.zeros(shape), np.zeros(shape)
        for sigma, share in ((7.0, 1.0), (25.0, 1e-3), (90.0, 1e-5)):
            total += share * gaussian_filter(weight, sigma / _CELL, mode="constant", truncate=6.0)
            mean += share * gaussian_filter(height, sigma / _CELL, mode="constant", truncate=6.0)
        x, y = (self._low[k] + _CELL * np.arange(shape[k]) for k in (0, 1))
        lines = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        level = float(np.mean(lane[:, 2]) - CAMERA_HEIGHT)
        surface = (mean + 1e-12 * level) / (total + 1e-12)
        off = np.clip((self._tree.query(lines)[0] - 14.0) / 30.0, 0.0, 1.0).reshape(shape)
        hills = noise(rng, x, 1, 1 / 200, 1 / 50) + noise(rng, y, 1, 1 / 200, 1 / 50).T
        return np.asarray(surface + 0.8 * off * hills)

    @staticmethod
    def _left(heading: np.ndarray) -> np.ndarray:
        return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


def footprint(place: np.ndarray, yaw: float, length: float, width: float) -> np.ndarray:
    """Places (N, 2) less than a metre apart all over a rectangle, its rim included."""
    rows, columns = int(length / 0.9) + 2, int(width / 0.9) + 2
    x = length * (np.arange(rows) / (rows - 1) - 0.5)[:, None]
    y = width * (np.arange(columns) / (columns - 1) - 0.5)
    c, s = math.cos(yaw), math.sin(yaw)
    points = np.empty((rows, columns, 2))
    points[..., 0], points[..., 1] = place[0] + c * x - s * y, place[1] + s * x + c * y
    return points.reshape(-1, 2)


def _flat_unit(vector: np.ndarray) -> np.ndarray:
    flat = vector * [1.0, 1.0, 0.0]
    return np.asarray(flat / np.linalg.norm(flat))

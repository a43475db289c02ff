"""Things of several parts, at rest or on the move, and bodies that keep within a camera's view."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.se3 import rigid_motion, transform_points
from sigmaslam_synthetic.motion.paths import Path, noise
from sigmaslam_synthetic.rendering.shapes import Box, Cylinder, Ellipsoid, Panel
from sigmaslam_synthetic.scene import Body

_HALF_VIEW = (np.tan(np.deg2rad(35.0)), 0.75 * np.tan(np.deg2rad(35.0)))
"""Half the view at distance 1 for which shares are meant: 70 degrees across, 4 : 3."""
_RASTER = (48, 36)
_KNOT_STEP = 0.4  # seconds between the knots of a mover's path


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of a model.

    Attributes:
        shape: its form.
        material: index into `Scene.materials`.
        position: of its centre in the model's frame, metres.
        rotation: rotation vector of T_model_part, radians.
    """

    shape: Box | Cylinder | Ellipsoid | Panel
    material: int
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def pose(self) -> np.ndarray:
        """T_model_part, (4, 4)."""
        return rigid_motion(Rotation.from_rotvec(self.rotation).as_matrix(), self.position)


Model = tuple[Part, ...]
"""A thing in its own frame."""


def stand(model: Model, T_world_model: np.ndarray) -> list[Body]:
    """The model at rest at a pose (4, 4)."""
    R = Rotation.from_matrix(T_world_model[:3, :3])
    rotations = (R * Rotation.from_rotvec([part.rotation for part in model])).as_rotvec().tolist()
    positions = transform_points(T_world_model, np.array([part.position for part in model]))
    return [
        Body(part.shape, part.material, tuple(position), tuple(rotation))
        for part, position, rotation in zip(model, positions.tolist(), rotations, strict=True)
    ]


def ride(model: Model, times: np.ndarray, T_world_model: np.ndarray) -> list[Body]:
    """The model on the move through poses (K, 4, 4) at times (K,), seconds."""
    return [Body(part.shape, part.material, path=Path.from_poses(times, T_world_model @ part.pose())) for part in model]


def scaled(model: Model, factor: float) -> Model:
    """The same model, larger by the factor."""

    def grown(shape: Box | Cylinder | Ellipsoid | Panel) -> Box | Cylinder | Ellipsoid | Panel:
        if isinstance(shape, Box):
            x, y, z = shape.size
            return Box((factor * x, factor * y, factor * z))
        if isinstance(shape, Cylinder):
            top = None if shape.top is None else factor * shape.top
            return replace(shape, radius=factor * shape.radius, length=factor * shape.length, top=top)
        if isinstance(shape, Ellipsoid):
            x, y, z = shape.radii
            return replace(shape, radii=(factor * x, factor * y, factor * z))
        return Panel(factor * shape.width, factor * shape.height)

    return tuple(
        replace(part, shape=grown(part.shape), position=(factor * x, factor * y, factor * z))
        for part in model
        for x, y, z in (part.position,)
    )


def bounds(model: Model, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of an upright box around a model that is turned about z."""
    c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
    turned = np.abs(Rotation.from_rotvec([part.rotation for part in model]).as_matrix())
    half_sizes = (turned @ np.array([_half_size(part.shape) for part in model])[:, :, None])[:, :, 0]
    places = np.array([part.position for part in model])
    lows, highs = places - half_sizes, places + half_sizes
    half = np.maximum(-np.min(lows, axis=0), np.max(highs, axis=0))[:2]
    reach = np.array([c * half[0] + s * half[1], s * half[0] + c * half[1]])
    return np.append(-reach, np.min(lows, axis=0)[2]), np.append(reach, np.max(highs, axis=0)[2])


def centred(model: Model) -> Model:
    """The same about its middle."""
    low, high = bounds(model, 0.0)
    x, y, z = (0.5 * (low + high)).tolist()
    return tuple(replace(q, position=(q.position[0] - x, q.position[1] - y, q.position[2] - z)) for q in model)


def knot_times(duration: float) -> np.ndarray:
    """Times of the knots of a mover's path, seconds."""
    return np.linspace(0.0, duration, max(2, round(duration / _KNOT_STEP) + 1))


def covered_share(models: Sequence[tuple[Model, np.ndarray]], T_world_camera: np.ndarray) -> np.ndarray:
    """Share of each view that models cover, were nothing in front of them.

    Args:
        models: and their T_world_model (V, 4, 4) at the views' times.
        T_world_camera: (V, 4, 4).
    Returns:
        (V,) in [0, 1].
    """
    outlines = [([_outline(part) for part in model], poses) for model, poses in models]
    half = np.array(_HALF_VIEW)
    shares = []
    for k, T_camera_world in enumerate(np.linalg.inv(T_world_camera)):
        raster = np.zeros(_RASTER[::-1], np.uint8)
        for parts, poses in outlines:
            T = T_camera_world @ poses[k]
            for points in parts:
                seen = transform_points(T, points)
                if seen[:, 2].max() < 0.05:
                    continue
                places = seen[:, :2] / np.maximum(seen[:, 2:], 0.05)
                pixels = (np.minimum(np.maximum(places / half, -40), 40) + 1) * 0.5 * _RASTER - 0.5
                cv2.fillConvexPoly(raster, cv2.convexHull((pixels * 16).astype(np.int32)), 1, cv2.LINE_8, 4)
        shares.append(raster.mean())
    return np.array(shares)


def follow(
    rng: np.random.Generator,
    camera: Path,
    duration: float,
    share: float,
    models: Sequence[Model],
    distance: tuple[float, float],
) -> list[Body]:
    """Bodies that keep in front of a camera, with smooth motions of their own.

    They turn about z only, and stay when the camera bobs.

    Args:
        camera: its path.
        duration: seconds.
        share: of the image that they cover together, on average.
        models: about the origin, of any size; they are enlarged to cover the share.
        distance: nearest and farthest that their nearest points come, metres.
    """
    times = knot_times(duration)
    at = camera.poses(times)
    frame = _level(at[:, :3, :3])
    ways = []
    for k, model in enumerate(models):
        # Side by side across the view, each with a wandering of its own.
        across = (2 * (k + 0.5) / len(models) - 1) * 0.75 * (len(models) > 1)
        wander = noise(rng, times, 2, 0.03, 0.15) * [0.13, 0.1]
        place = (wander + [across, rng.uniform(-0.25, 0.25)]) * _HALF_VIEW
        depth = rng.uniform(*distance) * np.exp(0.1 * noise(rng, times, 1, 0.03, 0.12)[:, 0])
        depth = np.clip(depth, *distance)
        T = np.tile(np.eye(4), (len(times), 1, 1))
        turn = rng.uniform(-np.pi, np.pi) + 0.4 * noise(rng, times, 1, 0.02, 0.1)[:, 0]
        T[:, :3, :3] = Rotation.from_euler("z", turn[:, None]).as_matrix()
        rays = (frame @ np.column_stack([place, np.ones(len(times))])[:, :, None])[:, :, 0]
        reach = float(np.linalg.norm(np.maximum(*np.abs(bounds(model, 0.0)))))
        ways.append((model, T, rays, depth, reach))
    chosen = np.unique(np.linspace(0, len(times) - 1, 10).astype(int))

    def placed(size: float) -> list[tuple[Model, np.ndarray]]:
        result = []
        for model, T, rays, depth, reach in ways:
            # The distance is that of the nearest side.
            T = T.copy()
            T[:, :3, 3] = at[:, :3, 3] + (depth + reach * size)[:, None] * rays
            result.append((model, T))
        return result

    def error(size: float) -> float:
        # Larger axes stand for a larger model.
        axes = np.array([[size, size, size, 1.0]])
        models_at = [(model, T[chosen] * axes) for model, T in placed(size)]
        return float(covered_share(models_at, at[chosen]).mean()) - share

    size = bisect(error, 0.02, 8.0)
    return [body for model, T in placed(size) for body in ride(scaled(model, size), times, T)]


def bisect(error: Callable[[float], float], low: float, high: float, steps: int = 9) -> float:
    """Where a function that rises with its argument, or falls, changes its sign; on a logarithmic scale.

    Args:
        error: of one argument.
        low, high: ends of the search, positive; the nearer one if the sign does not change.
        steps: halvings.
    """
    rises = error(high) > error(low)
    for _ in range(steps):
        middle = float(np.sqrt(low * high))
        if (error(middle) > 0) == rises:
            high = middle
        else:
            low = middle
    return float(np.sqrt(low * high))


def _half_size(shape: Box | Cylinder | Ellipsoid | Panel) -> tuple[float, float, float]:
    if isinstance(shape, Box):
        x, y, z = shape.size
        return x / 2, y / 2, z / 2
    if isinstance(shape, Cylinder):
        radius = max(shape.radius, shape.top or 0.0)
        return radius, radius, shape.length / 2
    return shape.radii if isinstance(shape, Ellipsoid) else (shape.width / 2, shape.height / 2, 0.0)


@lru_cache(maxsize=512)
def _outline(part: Part) -> np.ndarray:
    """Corners (n, 3) of a part, in the model's frame."""
    facets = part.shape.facets()
    points = np.concatenate([facets.origin, facets.origin + facets.edge_u, facets.origin + facets.edge_v])
    if isinstance(part.shape, Box | Panel):
        points = np.concatenate([points, facets.origin + facets.edge_u + facets.edge_v])
    T = part.pose()
    return transform_points(T, np.unique(points.round(6), axis=0))


def _level(R_world_camera: np.ndarray) -> np.ndarray:
    """The camera's frames (N, 3, 3) without pitch and roll: x right, y down, z ahead."""
    ahead = R_world_camera[:, :, 2] * [1, 1, 0]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    down = np.broadcast_to([0.0, 0.0, -1.0], ahead.shape)
    return np.stack([np.cross(down, ahead), down, ahead], axis=-1)

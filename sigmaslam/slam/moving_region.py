"""Where in the image something moves on its own, carried on from frame to frame."""

import numpy as np

from sigmaslam.frontend.knn import nearest_points
from sigmaslam.frontend.lucas_kanade import lucas_kanade
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.two_view.scene_pose import are_one_place

# Of the optical flow: side of its patches, pixels, and levels above the image itself.
_WINDOW, _LEVELS = 15, 3


class MovingRegion:
    """Places on bodies that move, each with the point in the world where it would be at rest.

    Args:
        radius: pixels around a place that are taken for the same body.
        patience: frames after which a place that is where a point at rest would be does not move.
    """

    def __init__(self, radius: float, patience: int) -> None:
        self._radius, self._patience = radius, patience
        self._left = np.zeros((0, 0), np.uint8)
        self._places, self._points, self._age = np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, np.int64)
        self._departure = np.zeros((0, 2))

    def __bool__(self) -> bool:
        return len(self._places) > 0

    def carry(self, left: np.ndarray, pose: np.ndarray, camera: RectifiedStereo) -> None:
        """Follows the places by optical flow into the next left image (H, W), seen from `pose` (4, 4)."""
        if len(self._places):
            at_rest, front = self._seen_from(pose, camera)
            guess = np.clip(at_rest + self._departure, 0, (left.shape[1] - 1, left.shape[0] - 1))
            self._places, found = lucas_kanade(self._left, left, self._places, guess, _WINDOW, _LEVELS)
            self._departure, self._age = self._places - at_rest, self._age + 1
            rests = are_one_place(np.linalg.norm(self._departure, axis=1))
            self._keep(found & front & ~(rests & (self._age > self._patience)))
        self._left = left

    def keep_if_seen_from(self, pose: np.ndarray, camera: RectifiedStereo) -> None:
        """Forgets all places unless at least half are nearer to where `pose` (4, 4) sees their points than to rest."""
        there, front = self._seen_from(pose, camera)
        apart = np.linalg.norm(there - self._places, axis=1)
        moves = front & (apart < np.linalg.norm(self._departure, axis=1))
        self._keep(np.full(len(moves), 2 * moves.sum() >= len(moves)))

    def _seen_from(self, pose: np.ndarray, camera: RectifiedStereo) -> tuple[np.ndarray, np.ndarray]:
        """(K, 2) where a camera sees the points at rest, and (K,) whether they are before it."""
        seen = transform_points(se3_inverse(pose), self._points)
        front = seen[:, 2] > 0.0
        return camera.project(np.where(front[:, None], seen, [0.0, 0.0, 1.0]))[:, :2], front

    def _keep(self, kept: np.ndarray) -> None:
        self._places, self._points = self._places[kept], self._points[kept]
        self._departure, self._age = self._departure[kept], self._age[kept]

    def add(self, places: np.ndarray, points: np.ndarray, departure: np.ndarray) -> None:
        """Takes places (K, 2) in the last image that was carried to, which are those of points (K, 3) in the world at
        rest but for a departure (K, 2), pixels."""
        new = ~self.covers(places, 0.5)
        self._places = np.concatenate([self._places, places[new]])
        self._points = np.concatenate([self._points, points[new]])
        self._departure = np.concatenate([self._departure, departure[new]])
        self._age = np.concatenate([self._age, np.zeros(new.sum(), np.int64)])

    def covers(self, places: np.ndarray, share: float = 1.0) -> np.ndarray:
        """(N,) bool, which places (N, 2) lie within that share of the radius of one of the region's."""
        if not len(self._places):
            return np.zeros(len(places), bool)
        nearest = self._places[nearest_points(self._places, places, 1)[:, 0]]
        return np.asarray(np.linalg.norm(places - nearest, axis=1) <= share * self._radius)

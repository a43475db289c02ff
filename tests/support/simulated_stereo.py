"""What all front ends without images have in common: their camera, their frames and the errors of their matches."""

from __future__ import annotations

import numpy as np

from sigmaslam.frontend.types import Features, StereoView, TemporalMatches
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.slam.tracker import TrackerConfig

# What the tracker assumes.
ASSUMED = TrackerConfig()


def parallel_camera(width: int, height: int, focal: float, baseline: float) -> StereoCamera:
    """Two equal eyes without distortion, side by side; of the calibration the disparity offset alone may be wrong."""
    eye = CameraModel(width, height, focal, focal, 0.5 * width, 0.5 * height)
    to_right = np.eye(4)
    to_right[0, 3] = baseline
    return StereoCamera(eye, eye, to_right, CalibrationSigmas.none())


def image_of(frame: int, width: int, height: int) -> np.ndarray:
    """A black image whose first two pixels are the frame's number."""
    image = np.zeros((height, width), np.uint8)
    image[0, :2] = frame % 256, frame // 256
    return image


def frame_of(image: np.ndarray) -> int:
    """The frame that an image stands for."""
    return int(image[0, 0]) + 256 * int(image[0, 1])


class SimulatedErrors:
    """Features and matches of numbered points, with exactly the errors that they claim.

    Args:
        random: of the errors that all views of a point share.
        points: how many there are in the world.
        place, disparity: standard deviations per axis of a match, and of a disparity, pixels.
        shared: share of a disparity's variance that is the same in all views of a point.
    """

    def __init__(
        self,
        random: np.random.Generator,
        points: int,
        place: float = 0.2,
        disparity: float = 0.25,
        shared: float = ASSUMED.shared_disparity,
    ) -> None:
        self.place, self.disparity = place, disparity
        self._shared = np.sqrt(shared) * disparity * random.standard_normal(points)
        self._own = np.sqrt(1.0 - shared) * disparity

    def view(
        self, left: np.ndarray, right: np.ndarray, truth: np.ndarray, seen: np.ndarray, random: np.random.Generator
    ) -> StereoView:
        """The points `seen` (K,) as features, each with its disparity; `truth` (N, 3) is of all points.

        `random` is of the view's own errors: trackers observe frames in any order, in any thread.
        """
        count = len(seen)
        keypoints = truth[seen, :2] + ASSUMED.keyframe_sigma * random.standard_normal((count, 2))
        features = Features(
            keypoints,
            np.zeros((count, 0), np.float32),
            np.ones(count, np.float32),
            np.full(count, ASSUMED.keyframe_sigma),
        )
        disparity = truth[seen, 2] + self._shared[seen] + self._own * random.standard_normal(count)
        return StereoView(left, right, features, disparity, np.full(count, self.disparity))

    def matches(self, index: np.ndarray, places: np.ndarray, disparity: np.ndarray) -> TemporalMatches:
        """Matches (M,) of the features `index`, seen there."""
        count = len(index)
        return TemporalMatches(
            index,
            places,
            disparity,
            np.tile(self.place**2 * np.eye(2), (count, 1, 1)),
            np.full(count, self.disparity),
            np.ones(count),
        )

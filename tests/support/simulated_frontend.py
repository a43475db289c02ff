"""A front end without images: points in a world, seen with exactly the errors that the matches claim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.frontend.types import KeypointSearch, StereoView, TemporalMatches
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.slam.tracker import Estimate, StereoTracker
from tests.support.estimates import squared_error
from tests.support.simulated_stereo import ASSUMED, SimulatedErrors, frame_of, image_of, parallel_camera


@dataclass(frozen=True)
class Scale:
    """A camera and how it moves.

    Attributes:
        width, height, focal: of the images, pixels.
        baseline: metres.
        nearest, farthest: depth of the points, metres; uniform in inverse depth.
        motion: (6,) typical motion from frame to frame in the camera's frame, metres and radians.
        interval: between frames, seconds.
    """

    width: int
    height: int
    focal: float
    baseline: float
    nearest: float
    farthest: float
    motion: tuple[float, ...]
    interval: float


SCALES = {
    "driving": Scale(1240, 376, 700.0, 0.54, 6.0, 60.0, (0, 0, 1.0, 0, 0.005, 0), 0.1),
    "drone": Scale(752, 480, 450.0, 0.11, 1.5, 8.0, (0.03, 0.01, 0.04, 0.005, 0.01, 0.01), 0.05),
    "endoscope": Scale(640, 512, 450.0, 0.0045, 0.04, 0.12, (0.0006, 0.0003, 0.0008, 0.004, 0.006, 0.01), 0.04),
}
# A keypoint keeps so far from the border of both images.
_BORDER = 5.0


class SimulatedFrontend:
    """Knows the world and which of its frames each image stands for.

    Args:
        scale: camera and motion.
        seed: of everything random.
        frames: how many.
        points: most that are seen at once.
        place, disparity: standard deviations per axis of a match, and of a disparity, pixels.
        offset: of all disparities, pixels.
        shared: share of a disparity's variance that is the same in all views of a point.
        shared_place: share of the variance of its places in other views that is the same in all of them.
        outliers: share of matches that are up to 20 px off.
    """

    name = "simulated"

    def __init__(
        self,
        scale: Scale,
        seed: int,
        frames: int,
        points: int = 150,
        place: float = 0.2,
        disparity: float = 0.25,
        offset: float = 0.3,
        shared: float = ASSUMED.shared_disparity,
        shared_place: float = ASSUMED.shared_place,
        outliers: float = 0.0,
    ) -> None:
        self._scale, self._seed, self._random = scale, seed, np.random.default_rng(seed)
        self._most, self._offset, self._outliers = points, offset, outliers
        self.camera = parallel_camera(scale.width, scale.height, scale.focal, scale.baseline)
        self.poses = self._path(frames)
        self._points = np.concatenate([self._cloud(pose, 2 if k else 4) for k, pose in enumerate(self.poses[::5])])
        self._errors = SimulatedErrors(self._random, len(self._points), place, disparity, shared)
        self._shared_place = shared_place
        self._place_errors: dict[int, np.ndarray] = {}
        self._priority = self._random.permutation(len(self._points))
        self._seen: dict[int, np.ndarray] = {}
        self._frames: dict[bytes, int] = {}

    def images(self, frame: int) -> np.ndarray:
        """A black image whose first two pixels are the frame's number."""
        return image_of(frame, self._scale.width, self._scale.height)

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        """Points in view as features, each with its disparity; the same whenever the frame is observed."""
        frame = frame_of(left)
        truth, visible = self._project(frame)
        seen = np.flatnonzero(visible)
        seen = np.sort(seen[np.argsort(self._priority[seen])[: self._most]])
        self._seen[frame] = seen
        view = self._errors.view(left, right, truth, seen, np.random.default_rng((self._seed, frame)))
        if len(seen):
            self._frames[view.features.keypoints[0].tobytes()] = frame
        return view

    def frame_of_key(self, key: StereoView) -> int:
        """Of a keyframe, whose image may have been packed since: by the errors of its first keypoint."""
        return self._frames[key.features.keypoints[0].tobytes()]

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        """The points that both see, wherever they were predicted; the same whenever they are matched."""
        frame = frame_of(view.left)
        random = np.random.default_rng((self._seed, self.frame_of_key(search.key), frame))
        wanted, seen = self._seen[self.frame_of_key(search.key)][search.index], self._seen[frame]
        both = np.isin(wanted, seen)
        points, count = wanted[both], int(both.sum())
        truth, _ = self._project(frame)
        # Of a keyframe's points in all views alike, and of this view alone.
        key = self.frame_of_key(search.key)
        if key not in self._place_errors:
            of_key = np.random.default_rng((self._seed, key, len(self._points)))
            self._place_errors[key] = of_key.standard_normal((len(self._points), 2))
        common = self._place_errors[key][points]
        own = random.standard_normal((count, 2))
        error = np.sqrt(self._shared_place) * common + np.sqrt(1.0 - self._shared_place) * own
        places = truth[points, :2] + self._errors.place * error
        wrong = random.random(count) < self._outliers
        places[wrong] += random.uniform(-20, 20, (int(wrong.sum()), 2))
        return self._errors.matches(search.index[both], places, view.disparity[np.searchsorted(seen, points)])

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        """The same as `match` finds in the pair observed."""
        view = self.observe(left, right)
        return [self.match(search, view) for search in searches]

    def _path(self, frames: int) -> np.ndarray:
        """Poses of a camera whose velocity wanders about the typical one."""
        scale = self._scale
        typical = np.array(scale.motion)
        depth = np.sqrt(scale.nearest * scale.farthest)
        # Half of what the tracker allows for.
        sigma = 0.5 * np.repeat([ASSUMED.acceleration * depth, ASSUMED.angular_acceleration], 3)
        motion, poses = typical, [np.eye(4)]
        for _ in range(frames - 1):
            change = sigma * scale.interval**1.5 * self._random.standard_normal(6)
            motion = typical + 0.9 * (motion + change - typical)
            poses.append(poses[-1] @ se3_exp(motion))
        return np.array(poses)

    def _cloud(self, pose: np.ndarray, share: int) -> np.ndarray:
        """Points about the frustum of a pose."""
        scale, count = self._scale, share * self._most // 2
        z = 1 / self._random.uniform(1 / scale.farthest, 1 / scale.nearest, count)
        x = self._random.uniform(-0.7, 0.7, count) * scale.width / scale.focal * z
        y = self._random.uniform(-0.7, 0.7, count) * scale.height / scale.focal * z
        return np.asarray(np.column_stack([x, y, z]) @ pose[:3, :3].T + pose[:3, 3])

    def _project(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """(u, v, disparity) of all points without noise, and which are in view."""
        return self._project_from(self.poses[frame])

    def _project_from(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same from any pose (4, 4)."""
        scale = self._scale
        T = se3_inverse(pose)
        points = self._points @ T[:3, :3].T + T[:3, 3]
        z = np.maximum(points[:, 2], 1e-9)
        u = scale.focal * points[:, 0] / z + 0.5 * scale.width
        v = scale.focal * points[:, 1] / z + 0.5 * scale.height
        disparity = scale.focal * scale.baseline / z + self._offset
        inside = (u - disparity > _BORDER) & (u < scale.width - _BORDER)
        inside &= (v > _BORDER) & (v < scale.height - _BORDER) & (points[:, 2] > 0.3 * scale.nearest)
        return np.column_stack([u, v, disparity]), inside


@dataclass(frozen=True)
class SimulatedRun:
    """A tracker after a run.

    Attributes:
        tracker: with its window.
        estimates: of all frames.
        poses: (N, 4, 4) true.
        nees: (N - 1,) per degree of freedom, from the second frame on.
    """

    tracker: StereoTracker
    estimates: list[Estimate]
    poses: np.ndarray
    nees: np.ndarray


def run_simulated(
    tracker: StereoTracker, frontend: SimulatedFrontend, scale: Scale, frames: int | None = None
) -> SimulatedRun:
    """All frames through a fresh tracker with that front end."""
    estimates = []
    for k in range(frames or len(frontend.poses)):
        image = frontend.images(k)
        estimates.append(tracker.step(image, image, k * scale.interval))
    pairs = zip(estimates[1:], frontend.poses[1:], strict=False)
    nees = [squared_error(estimate, truth) / 6 for estimate, truth in pairs]
    return SimulatedRun(tracker, estimates, frontend.poses, np.array(nees))

"""A ball that moves before a camera at rest, and a wall behind: matches have the errors they claim."""

from __future__ import annotations

import numpy as np

from sigmaslam.bodies.object_tracker import ObjectEstimate, ObjectTracker
from sigmaslam.frontend.types import KeypointSearch, StereoView, TemporalMatches
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from tests.support.quantiles import chi_square_quantile, squared_sigmas
from tests.support.simulated_stereo import SimulatedErrors, frame_of, image_of, parallel_camera

WIDTH, HEIGHT, FOCAL, BASELINE = 640, 480, 500.0, 0.1
DISTANCE, RADIUS, WALL = 1.0, 0.25, 1.5
INTERVAL = 0.05
_ELLIPSE = chi_square_quantile(0.99, 2)


class SimulatedBody:
    """A front end that knows the ball's pose in every frame.

    Args:
        poses: (N, 4, 4) T_camera_ball; its centre is the origin.
        seed: of everything random.
        ball, wall: number of points on each; half of the ball's are seen at once.
        hidden: frames in which the ball is not there.
    """

    name = "simulated"

    def __init__(self, poses: np.ndarray, seed: int = 0, ball: int = 300, wall: int = 300, hidden: range = range(0)):
        self.poses, self._hidden, self._seed, random = poses, hidden, seed, np.random.default_rng(seed)
        self.camera = parallel_camera(WIDTH, HEIGHT, FOCAL, BASELINE)
        normal = random.standard_normal((ball, 3))
        self._normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        spread = 0.9 * np.array([WIDTH, HEIGHT]) / FOCAL * WALL
        flat = random.uniform(-0.5, 0.5, (wall, 2)) * spread
        self._wall = np.column_stack([flat, np.full(wall, WALL)])
        self.is_ball = np.arange(ball + wall) < ball
        self._errors = SimulatedErrors(random, ball + wall)
        self.seen: dict[int, np.ndarray] = {}

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        """Points in view as features, each with its disparity."""
        frame = frame_of(left)
        truth, visible = self._project(frame)
        seen = np.flatnonzero(visible)
        self.seen[frame] = seen
        return self._errors.view(left, right, truth, seen, np.random.default_rng((self._seed, frame)))

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        """The points that both see, within the ellipses where there are any."""
        frame = frame_of(view.left)
        wanted, seen = self.seen[frame_of(search.key.left)][search.index], self.seen[frame]
        truth, _ = self._project(frame)
        random = np.random.default_rng((self._seed, frame_of(search.key.left), frame))
        places = truth[wanted, :2] + self._errors.place * random.standard_normal((len(wanted), 2))
        both = np.isin(wanted, seen)
        if search.covariance is not None:
            apart = places - search.predicted
            both &= np.einsum("ki,kij,kj->k", apart, np.linalg.inv(search.covariance), apart) < _ELLIPSE
        disparity = view.disparity[np.searchsorted(seen, wanted[both])]
        return self._errors.matches(search.index[both], places[both], disparity)

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        """The same as `match` finds in the pair observed."""
        view = self.observe(left, right)
        return [self.match(search, view) for search in searches]

    def _project(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """(u, v, disparity) of all points without noise, and which are in view."""
        T = self.poses[frame]
        normal = self._normal @ T[:3, :3].T
        ball = RADIUS * normal + T[:3, 3]
        points = np.concatenate([ball, self._wall])
        centre = T[:3, 3]
        ray = self._wall / np.linalg.norm(self._wall, axis=1, keepdims=True)
        covered = np.linalg.norm(np.cross(ray, centre), axis=1) < RADIUS
        shown = frame not in self._hidden
        facing = np.einsum("ki,ki->k", normal, ball) < -0.2 * np.linalg.norm(ball, axis=1)
        visible = np.concatenate([facing & shown, ~covered | (not shown)])
        z = points[:, 2]
        u, v = FOCAL * points[:, 0] / z + 0.5 * WIDTH, FOCAL * points[:, 1] / z + 0.5 * HEIGHT
        disparity = FOCAL * BASELINE / z
        visible &= (u - disparity > 5) & (u < WIDTH - 5) & (v > 5) & (v < HEIGHT - 5)
        return np.column_stack([u, v, disparity]), visible


def wandering(frames: int, seed: int = 0, rest: int = 0, speed: float = 1.0) -> np.ndarray:
    """T_camera_ball (frames, 4, 4): at rest for some frames, then about and turning, smoothly."""
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 6)
    t = speed * INTERVAL * np.maximum(np.arange(frames) - rest, 0)[:, None]
    ease = 1.0 - np.exp(-2.0 * t)
    rate = np.array([1.1, 0.9, 0.7, 0.8, 1.0, 0.6])
    size = np.array([0.25, 0.12, 0.12, 0.5, 0.6, 0.5])
    motion = ease * size * np.sin(rate * t + phase)
    poses = se3_exp(motion)
    poses[:, :3, 3] = motion[:, :3] + [0.0, 0.0, DISTANCE]
    return np.asarray(poses)


def box_around(pose: np.ndarray, grown: float = 1.0) -> np.ndarray:
    """(HEIGHT, WIDTH) bool: a box about the ball, `grown` times as large."""
    x, y, z = pose[:3, 3]
    half = grown * FOCAL * RADIUS / z
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(
        (np.abs(u - 0.5 * WIDTH - FOCAL * x / z) < half) & (np.abs(v - 0.5 * HEIGHT - FOCAL * y / z) < half)
    )


def follow(body: SimulatedBody, region: np.ndarray) -> tuple[ObjectTracker, list[ObjectEstimate]]:
    """All frames through a fresh tracker with that front end."""
    tracker = ObjectTracker(body.camera, region, body)
    images = [image_of(k, WIDTH, HEIGHT) for k in range(len(body.poses))]
    return tracker, [tracker.step(image, image, k * INTERVAL) for k, image in enumerate(images)]


def errors_of(body: SimulatedBody, estimates: list[ObjectEstimate]) -> np.ndarray:
    """(N, 6) errors of T_camera_object in the body's frame."""
    truth = body.poses @ se3_inverse(body.poses[0]) @ estimates[0].T_camera_object
    return se3_log(se3_inverse(truth) @ np.array([e.T_camera_object for e in estimates]))


def nees_of(errors: np.ndarray, estimates: list[ObjectEstimate]) -> np.ndarray:
    """(N - 1,) per degree of freedom, from the second frame on."""
    covariances = np.array([estimate.object_covariance for estimate in estimates[1:]])
    return squared_sigmas(errors[1:], covariances) / 6

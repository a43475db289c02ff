"""Worlds for a window of keyframes, and dense least squares over all poses, the calibration and the landmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from sigmaslam.estimation.calibration_errors import ERRORS, CalibrationPrior, measured_errors
from sigmaslam.estimation.estimator_graphs import EstimatorGraphs
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE, VIEW_TURNS
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_exp, se3_exp, se3_inverse, se3_log

CAMERA = RectifiedStereo(fx=400.0, fy=410.0, cx=319.5, cy=239.5, baseline=0.2, width=640, height=480)
# Standard deviations of the prior and of the noise; of the calibration offset, yaw and pitch are estimated.
CALIBRATION_SIGMA = np.array([0.5, 0.3, 0.3])
ESTIMATED = ERRORS[:3]
CONSIDERED = slice(len(ESTIMATED), CALIBRATION_SIZE)
NO_WALK = np.zeros(CALIBRATION_SIZE)
FIRST_SIGMA = np.repeat([0.02, 0.01], 3)
STEP_SIGMA = np.repeat([0.05, 0.02], 3)
HOST_SIGMA = np.array([0.1, 0.1, 0.15, 0.25])
VIEW_ROOT = np.array([[0.25, 0.0, 0.0], [0.1, 0.25, 0.0], [0.0, 0.05, 0.2]])
# How errors that a landmark's places share enter its views.
COMMON = np.array([[0.15, 0.02], [0.02, 0.1], [0.0, 0.0]])
STEP = se3_exp([0.15, -0.05, 0.3, 0.02, -0.05, 0.03])
KEYFRAMES = 3
# With deviations so small everything is linear, and equal numbers must be equal.
NARROW = 1e-3
# Of the scene, metres; linearisations of a frame's update; degrees of freedom of a Student-t that is as good as normal.
DEPTH, ITERATIONS, GAUSSIAN = 4.0, 2, 1e12


@dataclass(frozen=True)
class World:
    """Three keyframes and a frame after them on their way past points, and all that is measured there.

    Attributes:
        scale: of all standard deviations.
        expected, poses: (4, 4, 4) as the prior expects them, and true.
        calibration: (3,) true.
        host: (L,) keyframe that a landmark belongs to, ascending.
        landmarks, measured: (L, 6) true, and in the host.
        views: of each pose.
    """

    scale: float
    expected: np.ndarray
    poses: np.ndarray
    calibration: np.ndarray
    host: np.ndarray
    landmarks: np.ndarray
    measured: np.ndarray
    views: list[LandmarkViews]


def project(pose: np.ndarray, host: np.ndarray, calibration: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """(u, v, disparity) (L, 3) of landmarks (L, 6) of hosts (L, 4, 4), by way of the points themselves.

    Without the errors that its places share.
    """

    def bias(uvd: np.ndarray) -> np.ndarray:
        x, y = (uvd[:, 0] - uvd[:, 2] - CAMERA.cx) / CAMERA.fx, (uvd[:, 1] - CAMERA.cy) / CAMERA.fy
        return np.asarray(calibration[0] + calibration[1] * x * x + calibration[2] * x * y)

    true = landmarks[:, :3].copy()
    true[:, 2] -= landmarks[:, 3] + bias(landmarks)
    T = se3_inverse(pose) @ host
    seen = CAMERA.project((T[:, :3, :3] @ CAMERA.triangulate(true)[..., None])[..., 0] + T[:, :3, 3])
    seen[:, 2] += landmarks[:, 3] + bias(seen)
    return np.asarray(seen)


def world(seed: int = 0, scale: float = 1.0, count: int = 12, hosts: int = KEYFRAMES) -> World:
    """Everything drawn from the prior; the first `hosts` keyframes have landmarks of their own."""
    rng = np.random.default_rng(seed)
    expected, errors = [np.eye(4)], [FIRST_SIGMA * rng.standard_normal(6)]
    for _ in range(KEYFRAMES):
        expected.append(expected[-1] @ STEP)
        errors.append(errors[-1] + STEP_SIGMA * rng.standard_normal(6))
    poses = se3_exp(scale * np.array(errors)) @ np.array(expected)
    calibration = scale * CALIBRATION_SIGMA * rng.standard_normal(3)
    host = np.sort(np.arange(count) % hosts)
    true = 80 / rng.uniform(2.5, 9.0, count)
    own = scale * HOST_SIGMA[3] * rng.standard_normal(count)
    landmarks = np.c_[rng.uniform(120, 520, count), rng.uniform(100, 380, count), true + own, own]
    measured = np.pad(landmarks + scale * HOST_SIGMA * rng.standard_normal((count, 4)), ((0, 0), (0, 2)))
    measured[:, 3] = 0.0
    landmarks = np.c_[landmarks, np.random.default_rng(100 + seed).standard_normal((count, 2))]
    views = []
    for k, pose in enumerate(poses):
        rows = np.flatnonzero(host < k)
        seen = project(pose, poses[host[rows]], calibration, landmarks[rows])
        seen = seen + scale * (rng.standard_normal((len(rows), 3)) @ VIEW_ROOT.T + landmarks[rows, 4:] @ COMMON.T)
        seen[(rows + k) % 6 == 0, 2] = np.nan
        noise, common = scale**2 * VIEW_ROOT @ VIEW_ROOT.T, scale * COMMON
        views.append(LandmarkViews(rows, seen, np.tile(noise, (len(rows), 1, 1)), np.tile(common, (len(rows), 1, 1))))
    return World(scale, np.array(expected), poses, calibration, host, landmarks, measured, views)


def by_pair_with(given: World, errors: np.ndarray) -> World:
    """The same world seen by a pair with errors (15,), beside those that the world has anyway."""

    def off(uvd: np.ndarray) -> np.ndarray:
        return np.asarray(uvd + measured_errors(CAMERA, uvd) @ errors)

    def turned(uvd: np.ndarray, keyframes: np.ndarray) -> np.ndarray:
        """As seen by cameras that turn from keyframe to keyframe, and nobody knows."""
        rays = np.c_[(uvd[:, 0] - CAMERA.cx) / CAMERA.fx, (uvd[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(len(uvd))]
        x, y, z = (rotation_exp(keyframes[:, None] * errors[-VIEW_TURNS:] / CAMERA.fx) @ rays[..., None])[..., 0].T
        return np.c_[CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy, uvd[:, 2] / z]

    measured = np.c_[off(given.measured[:, :3]), given.measured[:, 3:]]
    views = [
        replace(views, measurement=turned(off(views.measurement), k - given.host[views.landmark]))
        for k, views in enumerate(given.views)
    ]
    return replace(given, measured=measured, views=views)


def make_window(
    calibration_sigma: np.ndarray,
    linearisation: str = "extended",
    camera: RectifiedStereo = CAMERA,
    considered_sigma: np.ndarray | None = None,
) -> KeyframeWindow:
    """An empty window of Gaussian errors: least squares alone, where there are weights for longer tails.

    Args:
        calibration_sigma: (3,) of the errors that are estimated.
        linearisation: "extended" or "unscented".
        camera: the rectified pair.
        considered_sigma: (12,) of those that are considered; none by default.
    """
    graphs = EstimatorGraphs(camera, "onnx", linearisation == "unscented")
    others = np.zeros(len(ERRORS) - len(ESTIMATED)) if considered_sigma is None else considered_sigma
    prior = CalibrationPrior.independent(np.r_[calibration_sigma, others], *ESTIMATED)
    return KeyframeWindow(camera, prior, graphs, student_freedom=GAUSSIAN)


def add_keyframe(window: KeyframeWindow, given: World, k: int, views: LandmarkViews, hosted: bool = True) -> None:
    sigma = given.scale * (STEP_SIGMA if k else FIRST_SIGMA)
    pose = window.posterior.poses[-1] @ STEP if k else given.expected[0]
    window.add_keyframe(pose, STEP if k else given.expected[0], np.diag(sigma**2), NO_WALK, DEPTH)
    window.add_views(views)
    own = np.flatnonzero(given.host == k) if hosted else np.zeros(0, np.int64)
    variance = np.tile((given.scale * HOST_SIGMA) ** 2, (len(own), 1))
    window.add_landmarks(own, given.measured[own, :3], variance)


def unsolved(
    given: World, linearisation: str = "extended", order: int = 1, considered_sigma: np.ndarray | None = None
) -> KeyframeWindow:
    """The keyframes and their views; order -1 hands them over from the last to the first."""
    window = make_window(given.scale * CALIBRATION_SIGMA, linearisation, considered_sigma=considered_sigma)
    for k in range(KEYFRAMES):
        add_keyframe(window, given, k, given.views[k].select(np.arange(len(given.views[k]))[::order]))
    return window


def solved(given: World, linearisation: str = "extended", order: int = 1) -> KeyframeWindow:
    """Iterated until nothing changes."""
    window = unsolved(given, linearisation, order)
    window.solve(8)
    return window


def fit(
    window: KeyframeWindow, given: World, views: LandmarkViews | None = None, start: np.ndarray | None = None
) -> FrameFit:
    """Of the frame after the keyframes."""
    step_covariance = np.diag((given.scale * STEP_SIGMA) ** 2)
    update = FrameUpdate(window, ITERATIONS)
    found = update.fit(views or given.views[-1], window.posterior.poses[-1] @ STEP, step_covariance, 5, start)
    assert found is not None
    return found


class Dense:
    """All unknowns in one vector (calibration, poses, landmarks), solved at once.

    Args:
        given: world.
        poses: how many of its poses take part.
        hosts: keyframes whose landmarks take part.
    """

    def __init__(self, given: World, poses: int, hosts: Iterable[int] = range(KEYFRAMES)) -> None:
        self.given, self.size = given, 3 + 6 * poses
        self.expected = given.expected[:poses]
        self.views = [v.select(np.isin(given.host[v.landmark], list(hosts))) for v in given.views[:poses]]
        self.whiteners = []
        for views in self.views:
            whitener = np.linalg.inv(np.linalg.cholesky(views.noise))
            # The third row alone has to do with the disparity, and the first two are those of the place alone.
            whitener[np.isnan(views.measurement[:, 2]), 2] = 0.0
            self.whiteners.append(whitener)
        self.at = np.r_[np.zeros(self.size), given.measured.ravel()]
        # The landmark that each residual has to do with, -1 of none.
        landmarks = np.arange(len(given.host))
        of_views = [np.repeat(views.landmark, 3) for views in self.views]
        of_priors = [np.full(self.size, -1), np.repeat(landmarks, 4), np.repeat(landmarks, 2)]
        self.landmark_of = np.concatenate([*of_priors, *of_views])

    def residuals(self, at: np.ndarray) -> np.ndarray:
        """In standard deviations."""
        given, scale = self.given, self.given.scale
        calibration, tangents, landmarks = at[:3], at[3 : self.size].reshape(-1, 6), at[self.size :].reshape(-1, 6)
        poses = se3_exp(tangents) @ self.expected
        parts = [calibration / CALIBRATION_SIGMA, tangents[0] / FIRST_SIGMA]
        parts.append((np.diff(tangents, axis=0) / STEP_SIGMA).ravel())
        parts.append(((landmarks - given.measured)[:, :4] / HOST_SIGMA).ravel())
        parts = [*(part / scale for part in parts), landmarks[:, 4:].ravel()]
        for pose, views, whitener in zip(poses, self.views, self.whiteners, strict=True):
            seen = project(pose, poses[given.host[views.landmark]], calibration, landmarks[views.landmark])
            seen = seen + (views.common @ landmarks[views.landmark, 4:, None])[..., 0]
            rest = np.nan_to_num(views.measurement - seen)
            parts.append((whitener @ rest[..., None]).ravel())
        return np.concatenate(parts)

    def derivative(self, at: np.ndarray) -> np.ndarray:
        """Of the residuals by calibration, poses perturbed from the left, and landmarks."""

        def turned(change: np.ndarray) -> np.ndarray:
            there = at + change
            tangents = [a[3 : self.size].reshape(-1, 6) for a in (change, at)]
            there[3 : self.size] = se3_log(se3_exp(tangents[0]) @ se3_exp(tangents[1])).ravel()
            return there

        return self._differences(turned)

    def _differences(self, moved: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Of the residuals by changes; a residual has to do with one landmark at most, so all move at once."""
        # With 1e-6, round-off moved solutions by 1e-4 sigmas of a landmark; with this 2e-6, and not by the step.
        step = 1e-4

        def difference(change: np.ndarray) -> np.ndarray:
            return (self.residuals(moved(step * change)) - self.residuals(moved(-step * change))) / (2 * step)

        unit = np.eye(len(self.at))
        J = np.zeros((len(self.landmark_of), len(self.at)))
        for k in range(self.size):
            J[:, k] = difference(unit[k])
        rows = np.flatnonzero(self.landmark_of >= 0)
        for k in range(self.size, self.size + 6):
            J[rows, k + 6 * self.landmark_of[rows]] = difference(unit[k::6].sum(axis=0))[rows]
        return J

    def solve(self) -> Dense:
        def jacobian(at: np.ndarray) -> np.ndarray:
            return self._differences(lambda change: at + change)

        tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
        self.at = least_squares(self.residuals, self.at, jacobian, x_scale="jac", **tolerances).x
        return self

    @property
    def poses(self) -> np.ndarray:
        return np.asarray(se3_exp(self.at[3 : self.size].reshape(-1, 6)) @ self.expected)

    @property
    def cost(self) -> float:
        return float((self.residuals(self.at) ** 2).sum())

    def information(self) -> np.ndarray:
        J = self.derivative(self.at)
        return np.asarray(J.T @ J)

    def covariance(self) -> np.ndarray:
        """Of calibration and poses."""
        return np.asarray(np.linalg.inv(self.information())[: self.size, : self.size])


def dense_slice(pose: int) -> slice:
    """Where a pose stands among the dense unknowns."""
    return slice(len(ESTIMATED) + 6 * pose, len(ESTIMATED) + 6 * pose + 6)


def without_considered(matrix: np.ndarray) -> np.ndarray:
    """A covariance or information of a window's state without the rows and columns of the considered errors."""
    kept = np.r_[0 : len(ESTIMATED), CALIBRATION_SIZE : len(matrix)]
    return np.asarray(matrix[np.ix_(kept, kept)])


def eliminate(information: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Schur's complement: the information about what is kept."""
    gone = np.setdiff1d(np.arange(len(information)), kept)
    cross = information[np.ix_(gone, kept)]
    return information[np.ix_(kept, kept)] - cross.T @ np.linalg.solve(information[np.ix_(gone, gone)], cross)


def in_sigmas(covariance: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference of two covariances, in deviations of the second."""
    sigma = np.sqrt(np.diag(expected))
    return float(np.abs((covariance - expected) / np.outer(sigma, sigma)).max())


def assert_same_state(
    poses: np.ndarray, calibration: np.ndarray, covariance: np.ndarray, dense: Dense, tolerance: float, first: int = 0
) -> None:
    """Estimates and covariances of the poses from `first` on, in standard deviations."""
    chosen = np.r_[0:3, 3 + 6 * first : dense.size]
    expected = dense.covariance()[np.ix_(chosen, chosen)]
    covariance = without_considered(covariance)
    difference = np.r_[calibration[:3] - dense.at[:3], se3_log(poses @ se3_inverse(dense.poses[first:])).ravel()]
    assert np.abs(difference / np.sqrt(np.diag(expected))).max() < tolerance
    assert in_sigmas(covariance, expected) < tolerance

"""Keyframes, landmarks and the disparity offset by GTSAM.

GTSAM solves for keyframes and landmarks at a fixed offset, which its stereo factor does not model. The offset minimises
the profile of the cost, in which everything else is optimal: there the gradient by the offset is zero.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sigmaslam.bundle_adjustment.gtsam_bridge import load_gtsam, swap_tangent
from sigmaslam.bundle_adjustment.structure import HUBER, Observations, whitened_residuals
from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log, turn_covariance

# This standard deviation, metres and radians, fixes the first keyframe.
_FIXED = 1e-8
_MAX_ITERATIONS = 50
# An iteration that reduces half the sum of squares by less leaves every state within 0.001 standard deviations.
_CONVERGED = 1e-6
# The solution with Huber's loss only serves to reject outliers. It stops at this share of the cost.
_NEARLY_CONVERGED = 1e-4
# This step, pixels, measures the curvature of the profile by a difference.
_PROBE = 0.05
# The search for the offset stops at a step of so many standard deviations.
_OFFSET_CONVERGED = 1e-2
_MAX_OFFSET_STEPS = 10
# Keyframes that share fewer landmarks are not connected.
_MIN_SHARED = 10
# This matrix takes (u, v, disparity) to (u_left, u_right, v), GTSAM's order.
_STEREO_FROM_DISPARITY = np.array([[1.0, 0, 0], [1, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, slots=True)
class Solution:
    """Poses of the rectified camera, points and offset at a minimum, with the graph behind them."""

    poses: np.ndarray
    points: np.ndarray
    offset: float
    graph: Any
    values: Any


@dataclass(frozen=True, slots=True)
class Bridge:
    """The tracker's motion between two keyframes, where the tracks break off.

    Attributes:
        T_i_j: (4, 4) takes j to i, metres.
        covariance: (6, 6) of x in T_i_j exp(x), x = (translation, rotation).
    """

    i: int
    j: int
    T_i_j: np.ndarray
    covariance: np.ndarray


class Solver:
    """Builds and solves the graphs of one set of tracks.

    Args:
        observations: of all keyframes.
        tracked: (K, 4, 4) T_world_camera of the rectified camera, as tracked.
        covariances: (K, 6, 6) of the tracked poses.
        tell: receives messages on the progress.
    Raises:
        InputError: gtsam is not installed.
    """

    def __init__(
        self, observations: Observations, tracked: np.ndarray, covariances: np.ndarray, tell: Callable[[str], None]
    ) -> None:
        self._gtsam = load_gtsam()
        self._observations = observations
        self._tracked = tracked
        self._covariances = covariances
        self._tell = tell
        # Keys: landmarks, then keyframes.
        self._first_pose_key = len(observations.host)
        self.iterations = 0
        self.solves = 0
        self.converged = True

    def solve(
        self, kept: np.ndarray, poses: np.ndarray, points: np.ndarray, offset: float, robust: bool = False
    ) -> Solution:
        """The best poses and points for one offset.

        Args:
            kept: (O,) bool, the observations to use.
            poses, points: start of the iteration.
            offset: pixels.
            robust: use Huber's loss and stop early, which suffices to reject outliers.
        """
        gtsam = self._gtsam
        graph = self._graph(kept, offset, robust)
        landmarks = np.unique(self._observations.landmark[kept])
        values = gtsam.Values()
        for key in landmarks.tolist():
            values.insert(key, points[key])
        for key, pose in enumerate(poses, start=self._first_pose_key):
            values.insert(key, gtsam.Pose3(pose))
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
        self.solves += 1
        cost = optimiser.error()
        for _ in range(_MAX_ITERATIONS):
            optimiser.iterate()
            self.iterations += 1
            gain, cost = cost - optimiser.error(), optimiser.error()
            self._tell(f"solve {self.solves}, iteration {self.iterations}, offset {offset:+.4f} px, cost {cost:.1f}")
            if gain <= (_NEARLY_CONVERGED * cost if robust else _CONVERGED):
                break
        else:
            # The solution with Huber's loss is only a start and need not converge.
            self.converged &= robust
        values = optimiser.values()
        points = points.copy()
        points[landmarks] = [values.atPoint3(key) for key in landmarks.tolist()]
        keys = range(self._first_pose_key, self._first_pose_key + len(poses))
        return Solution(np.stack([values.atPose3(key).matrix() for key in keys]), points, offset, graph, values)

    def solve_with_offset(
        self, kept: np.ndarray, poses: np.ndarray, points: np.ndarray, offset: float, prior_sigma: float
    ) -> tuple[Solution, float, np.ndarray]:
        """The best poses, points and offset, by secants of the profile's gradient.

        Returns:
            The solution, the curvature of the profile (the inverse of the offset's variance), and how the poses
            (K, 6), each in its own frame, change with the offset.
        """

        def gradient(solution: Solution) -> float:
            residuals, _ = whitened_residuals(self._observations, solution.poses, solution.points, solution.offset)
            by_data = float(np.sum(self._observations.whitening[:, :, 2] * np.where(kept[:, None], residuals, 0.0)))
            return by_data + solution.offset / prior_sigma**2

        solution = self.solve(kept, poses, points, offset)
        probe = self.solve(kept, solution.poses, solution.points, solution.offset + _PROBE)
        slope = gradient(solution)
        # The prior is the lower bound of the curvature.
        curvature = max((gradient(probe) - slope) / _PROBE, prior_sigma**-2)
        by_offset = se3_log(se3_inverse(solution.poses) @ probe.poses) / _PROBE
        points_by_offset = (probe.points - solution.points) / _PROBE
        for _ in range(_MAX_OFFSET_STEPS):
            step = -slope / curvature
            if abs(step) * math.sqrt(curvature) < _OFFSET_CONVERGED:
                break
            poses, points = solution.poses @ se3_exp(step * by_offset), solution.points + step * points_by_offset
            solution = self.solve(kept, poses, points, solution.offset + step)
            before, slope = slope, gradient(solution)
            # The difference over a short step is dominated by rounding.
            if abs(step) > 0.1 * _PROBE:
                curvature = max((slope - before) / step, prior_sigma**-2)
        else:
            self.converged = False
        return solution, curvature, by_offset

    def pose_covariances(self, solution: Solution) -> np.ndarray:
        """Covariances (K, 6, 6) of the poses, each in its own frame, given first pose and offset."""
        self._tell("covariances")
        keys = range(self._first_pose_key, self._first_pose_key + len(solution.poses))
        try:
            marginals = self._gtsam.Marginals(solution.graph, solution.values)
            return swap_tangent(np.stack([marginals.marginalCovariance(key) for key in keys]))
        except RuntimeError as error:
            raise SigmaSlamError(
                "the tracks do not fix every keyframe and landmark, so there is no covariance: track with more features"
            ) from error

    def bridges(self, kept: np.ndarray) -> list[Bridge]:
        """The tracker's motion from the keyframe before each gap in the tracks, so that all keyframes are connected."""
        landmark, keyframe = self._observations.landmark[kept], self._observations.keyframe[kept]
        order = np.lexsort([keyframe, landmark])
        landmark, keyframe = landmark[order], keyframe[order]
        same = landmark[1:] == landmark[:-1]
        # Each row is a pair of successive keyframes that observe one landmark.
        steps = np.column_stack([keyframe[:-1], keyframe[1:]])[same]
        pairs, shared = np.unique(steps, axis=0, return_counts=True)
        label = connected_parts(len(self._tracked), map(tuple, pairs[shared >= _MIN_SHARED].tolist()))
        return [self._motion(j) for j in np.unique(label)[1:].tolist()]

    def _motion(self, j: int) -> Bridge:
        """The tracker's motion from keyframe j - 1 to j, with the growth of its covariance."""
        motion = se3_inverse(self._tracked[j - 1]) @ self._tracked[j]
        growth = self._covariances[j] - turn_covariance(se3_inverse(motion), self._covariances[j - 1])
        try:
            root = np.linalg.cholesky(self._covariances[j])
        except np.linalg.LinAlgError:
            raise InputError(
                f"the tracks break off before keyframe {j}, and the covariance there is not positive definite, so the "
                "gap cannot be bridged: track again"
            ) from None
        # A filter may have reduced the covariance in some directions: the growth is at least a hundredth of it.
        whitened = np.linalg.solve(root, np.linalg.solve(root, growth).T)
        size, axes = np.linalg.eigh(0.5 * (whitened + whitened.T))
        factor = root @ axes * np.sqrt(np.maximum(size, 0.01))
        return Bridge(j - 1, j, motion, factor @ factor.T)

    def _graph(self, kept: np.ndarray, offset: float, robust: bool) -> Any:
        gtsam, observations, first = self._gtsam, self._observations, self._first_pose_key
        fx, fy, cx, cy, baseline = observations.intrinsics.tolist()
        stereo_camera = gtsam.Cal3_S2Stereo(fx, fy, 0.0, cx, cy, baseline)
        camera = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
        huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
        whitening = observations.whitening @ np.linalg.inv(_STEREO_FROM_DISPARITY)
        graph = gtsam.NonlinearFactorGraph()
        rows = np.flatnonzero(kept)
        for row, key, pose, (u, v, disparity), stereo in zip(
            rows.tolist(),
            observations.landmark[rows].tolist(),
            (first + observations.keyframe[rows]).tolist(),
            observations.measurement[rows].tolist(),
            observations.stereo[rows].tolist(),
            strict=True,
        ):
            root = whitening[row] if stereo else observations.whitening[row, :2, :2]
            noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
            if robust:
                noise = gtsam.noiseModel.Robust.Create(huber, noise)
            # The last two arguments suppress exception and message for points behind the camera.
            if stereo:
                measured = gtsam.StereoPoint2(u, u - (disparity - offset), v)
                graph.add(gtsam.GenericStereoFactor3D(measured, noise, pose, key, stereo_camera, False, False))
            else:
                place = np.array([u, v])
                graph.add(gtsam.GenericProjectionFactorCal3_S2(place, noise, pose, key, camera, False, False))
        fixed = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
        graph.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(self._tracked[0]), fixed))
        for bridge in self.bridges(kept):
            noise = gtsam.noiseModel.Gaussian.Covariance(swap_tangent(bridge.covariance))
            graph.add(gtsam.BetweenFactorPose3(first + bridge.i, first + bridge.j, gtsam.Pose3(bridge.T_i_j), noise))
        return graph


def connected_parts(count: int, pairs: Iterable[tuple[int, int]]) -> np.ndarray:
    """Connected components of a graph: the lowest member of each node's component, (count,)."""
    label = np.arange(count)
    for i, j in pairs:
        low, high = sorted((label[i], label[j]))
        label[label == high] = low
    return label

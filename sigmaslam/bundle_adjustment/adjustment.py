"""Bundle adjustment of a run's tracks (extra `graph`)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sigmaslam.bundle_adjustment import structure
from sigmaslam.bundle_adjustment.solver import Solver
from sigmaslam.bundle_adjustment.track_file import Tracks
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rigid_motion, se3_inverse, turn_covariance

# A smaller share of inliers is no solution.
_MIN_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class RefineConfig:
    """Settings.

    Attributes:
        offset_sigma: prior of the disparity offset about zero, pixels; wide, as rectifications of real data are off by
            up to a pixel.
        min_significance: landmarks whose inverse depth is fewer standard deviations above zero are not used, as
            Euclidean coordinates have no points at infinity.
    """

    offset_sigma: float = 1.0
    min_significance: float = 3.0


@dataclass(frozen=True, slots=True)
class Adjustment:
    """Result of the adjustment.

    Attributes:
        frames: (K,) rows of the keyframes in the trajectory.
        poses: (K, 4, 4) T_world_camera of the left camera.
        covariances: (K, 6, 6) of the poses in the camera's frame, (translation, rotation), given the first pose.
        points: (L, 3) landmarks in the world, metres.
        point_covariances: (L, 3, 3) given poses and offset.
        point_views: (L,) observations of each landmark in use.
        disparity_offset, disparity_offset_sigma: pixels.
        observations: number in use.
        outliers: number of rejected observations.
        far_landmarks: number of landmarks that are not used because they may be at infinity.
        bridges: number of gaps in the tracks that the tracker's motion spans.
        dof: degrees of freedom of the residuals.
        cost_before, cost_after: sum of squared whitened residuals of the observations in use, per degree of freedom,
            at the tracker's poses and offset with the points that fit these best, and at the solution.
        iterations: Levenberg-Marquardt steps of all solves.
        solves: number of solves of the graph.
        converged: False when a solve or the search for the offset reached its limit of iterations.
    """

    frames: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    points: np.ndarray
    point_covariances: np.ndarray
    point_views: np.ndarray
    disparity_offset: float
    disparity_offset_sigma: float
    observations: int
    outliers: int
    far_landmarks: int
    bridges: int
    dof: int
    cost_before: float
    cost_after: float
    iterations: int
    solves: int
    converged: bool


def adjust(
    tracks: Tracks,
    poses: np.ndarray,
    covariances: np.ndarray,
    config: RefineConfig | None = None,
    tell: Callable[[str], None] = lambda note: None,
) -> Adjustment:
    """Bundle adjustment of a run's tracks.

    The first solve uses Huber's loss. Two more follow without it: each rejects the observations beyond the 99.9 %
    quantile and weights the others by their covariances. The last one also estimates the offset.

    Args:
        poses: (N, 4, 4) T_world_camera of all frames, as tracked.
        covariances: (N, 6, 6) of the poses; only their growth over gaps in the tracks is used.
        tell: receives messages on the progress.
    Raises:
        InputError: gtsam is not installed, there is nothing to adjust, or the tracks do not fix all poses.
    """
    config = config or RefineConfig()
    observations, frames = structure.collect(tracks)
    if len(frames) < 2:
        raise InputError("all observations are of one keyframe: there is no motion to adjust; track more frames")
    T_left_rectified = rigid_motion(tracks.R_rectified_left.T, np.zeros(3))
    tracked = poses[frames] @ T_left_rectified
    offset = float(tracks.disparity_offset[0])
    rectified = turn_covariance(se3_inverse(T_left_rectified), covariances[frames])
    solver = Solver(observations, tracked, rectified, tell)
    selection = _Selection(
        observations, structure.seen_again(observations, np.ones(len(observations), bool)), config, tell
    )

    repeated = selection.repeated
    landmarks, far = selection.fit(repeated, tracked, offset)
    kept = structure.choose(observations, repeated, landmarks, tracked, offset, config.min_significance, gated=False)
    if not kept.any():
        raise InputError(
            f"none of {len(landmarks.points)} landmarks is seen by two keyframes and near enough to have a depth: "
            "there is nothing to adjust"
        )
    solution = solver.solve(kept, tracked, landmarks.points, offset, robust=True)
    kept, landmarks = selection.inliers(kept, solution.poses, offset)
    solution = solver.solve(kept, solution.poses, landmarks.points, offset)
    kept, landmarks = selection.inliers(kept, solution.poses, offset)
    while True:
        solution, curvature, by_offset = solver.solve_with_offset(
            kept, solution.poses, landmarks.points, solution.offset, config.offset_sigma
        )
        # Reject landmarks that have moved to infinity. The limit is halved, or those near it would come and go.
        landmarks, far = selection.fit(kept, solution.poses, solution.offset)
        limit = 0.5 * config.min_significance
        near = structure.choose(observations, kept, landmarks, solution.poses, solution.offset, limit, gated=False)
        if np.array_equal(near, kept):
            break
        kept = near

    sigma = 1.0 / math.sqrt(curvature)
    covariance = solver.pose_covariances(solution)
    # The offset is not a state of the graph: its uncertainty adds to that of the poses.
    covariance += sigma**2 * by_offset[:, :, None] * by_offset[:, None, :]
    covariance[0] = 0.0
    used = np.unique(observations.landmark[kept])
    bridges = len(solver.bridges(kept))
    components = int(np.where(observations.stereo[kept], 3, 2).sum())
    dof = components - 3 * len(used) - 6 * (len(frames) - 1) - 1 + 6 * bridges
    before = structure.fit_structure(observations, kept, tracked, offset)
    return Adjustment(
        frames=frames,
        poses=solution.poses @ se3_inverse(T_left_rectified),
        covariances=turn_covariance(T_left_rectified, covariance),
        points=solution.points[used],
        point_covariances=structure.point_covariances(observations, kept, solution.poses, solution.points)[used],
        point_views=np.bincount(observations.landmark[kept], minlength=len(observations.host))[used],
        disparity_offset=solution.offset,
        disparity_offset_sigma=sigma,
        observations=int(kept.sum()),
        outliers=int((repeated & ~kept & ~far).sum()),
        far_landmarks=len(np.unique(observations.landmark[far & ~kept])),
        bridges=bridges,
        dof=dof,
        cost_before=_sum_of_squares(observations, kept, tracked, before.points, offset) / max(dof, 1),
        cost_after=_sum_of_squares(observations, kept, solution.poses, solution.points, solution.offset) / max(dof, 1),
        iterations=solver.iterations,
        solves=solver.solves,
        converged=solver.converged,
    )


@dataclass(frozen=True, slots=True)
class _Selection:
    """Chooses among the `repeated` observations (O,) bool, those of landmarks that two keyframes or more see."""

    observations: structure.Observations
    repeated: np.ndarray
    config: RefineConfig
    tell: Callable[[str], None]

    def fit(self, kept: np.ndarray, poses: np.ndarray, offset: float) -> tuple[structure.Structure, np.ndarray]:
        """Points at fixed poses, and which repeated observations (O,) are of far landmarks.

        Landmarks without a kept observation use all of theirs.
        """
        self.tell("points by themselves")
        landmark = self.observations.landmark
        unused = np.bincount(landmark[kept], minlength=len(self.observations.host)) == 0
        landmarks = structure.fit_structure(self.observations, kept | (self.repeated & unused[landmark]), poses, offset)
        return landmarks, self.repeated & ~(landmarks.significance >= self.config.min_significance)[landmark]

    def inliers(self, kept: np.ndarray, poses: np.ndarray, offset: float) -> tuple[np.ndarray, structure.Structure]:
        """Inliers (O,) of a solution, and points that fit it."""
        landmarks, far = self.fit(kept, poses, offset)
        limit = self.config.min_significance
        inliers = structure.choose(self.observations, self.repeated, landmarks, poses, offset, limit, gated=True)
        near = int((self.repeated & ~far).sum())
        if inliers.sum() < max(_MIN_SHARE * near, 1):
            raise InputError(
                f"{inliers.sum()} of {near} observations agree on where things are: too few. Are trajectory and "
                "tracks of the same run?"
            )
        return inliers, landmarks


def _sum_of_squares(
    observations: structure.Observations, kept: np.ndarray, poses: np.ndarray, points: np.ndarray, offset: float
) -> float:
    points = np.nan_to_num(points)
    residuals, _ = structure.whitened_residuals(observations, poses, points, offset)
    return float(np.sum(residuals[kept] ** 2))

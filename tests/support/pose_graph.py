"""Pose graphs by GTSAM, the reference for what the window and its marginalised poses must agree with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sigmaslam.bundle_adjustment.gtsam_bridge import load_gtsam, swap_tangent
from sigmaslam.bundle_adjustment.solver import connected_parts
from sigmaslam.geometry.se3 import se3_inverse, turn_covariance

# Metres and radians: holds the first pose in place. What is not known of it is added to the result.
_FIXED = 1e-8
# A right edge is switched off once in a thousand; a wrong one is seldom wrong by so little.
_CONFIDENCE = 0.999


@dataclass(frozen=True, slots=True)
class PoseEdge:
    """A measured relative pose.

    Attributes:
        i, j: which poses.
        T_i_j: (4, 4) takes j to i, metres.
        covariance: (6, 6) of x in T_i_j exp(x), x = (translation, rotation).
        doubtful: it may be wrong altogether, as a loop may; then it is used whole or not at all.
    """

    i: int
    j: int
    T_i_j: np.ndarray
    covariance: np.ndarray
    doubtful: bool = False


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """The most probable poses.

    Attributes:
        poses: (K, 4, 4) T_world_keyframe.
        covariances: (K, 6, 6) of each pose in its own frame, (translation, rotation), given that the edges in use are
            right.
        used: (E,) bool, False for the doubtful edges that were found wrong.
    """

    poses: np.ndarray
    covariances: np.ndarray
    used: np.ndarray


def optimise_pose_graph(
    poses: np.ndarray, edges: Sequence[PoseEdge], first_covariance: np.ndarray | None = None
) -> PoseGraphResult:
    """Poses that fit the edges best by least squares, the first one where it is.

    Doubtful edges enter by truncated least squares, solved by graduated non-convexity (Yang, Antonante, Tzoumas,
    Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020): an edge is switched off when the
    others would have to give way by more than a 99.9 % quantile to it. The drift that a right loop removes is no
    reason, however large, as long as the covariances of the other edges allow for it.

    Args:
        poses: (K, 4, 4) where to start from.
        edges: those that are not doubtful must connect all poses.
        first_covariance: (6, 6) of the first pose in its own frame, (translation, rotation); zero by default. It may
            be singular.
    Raises:
        InputError: gtsam is not installed.
        ValueError: a shape is wrong, an edge has no regular covariance or leads nowhere, or a pose is not connected.
    """
    gtsam = load_gtsam()
    _check(poses, edges)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)))
    for edge in edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(swap_tangent(edge.covariance))
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T_i_j), noise))
    values = gtsam.Values()
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))

    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-12)
    settings.setAbsoluteErrorTol(1e-12)
    used = np.ones(len(edges), bool)
    if any(edge.doubtful for edge in edges):
        values, used = _judge(gtsam, graph, values, edges, settings)
        # Factor 0 holds the first pose.
        for index in np.flatnonzero(~used):
            graph.remove(int(index) + 1)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()

    count = len(poses)
    marginals = gtsam.Marginals(graph, values)
    optimised = np.stack([values.atPose3(key).matrix() for key in range(count)])
    covariances = swap_tangent(np.stack([marginals.marginalCovariance(key) for key in range(count)]))
    covariances[0] = 0.0
    if first_covariance is not None:
        # The edges are relative, so nothing but the first pose's own covariance depends on where it is.
        covariances = covariances + turn_covariance(se3_inverse(optimised) @ optimised[0], first_covariance)
    return PoseGraphResult(optimised, covariances, used)


def _judge(gtsam: Any, graph: Any, values: Any, edges: Sequence[PoseEdge], settings: Any) -> tuple[Any, np.ndarray]:
    """Values near the solution and (E,) which edges are right, by graduated non-convexity."""
    parameters = gtsam.GncLMParams(settings)
    parameters.setKnownInliers([0, *(index + 1 for index, edge in enumerate(edges) if not edge.doubtful)])
    optimiser = gtsam.GncLMOptimizer(graph, values, parameters)
    optimiser.setInlierCostThresholdsAtProbability(_CONFIDENCE)
    values = optimiser.optimize()
    return values, np.asarray(optimiser.getWeights())[1:] > 0.5


def _check(poses: np.ndarray, edges: Sequence[PoseEdge]) -> None:
    count = len(poses)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or count == 0:
        raise ValueError(f"poses must be (K, 4, 4) with K at least 1, got {poses.shape}")
    for index, edge in enumerate(edges):
        name = f"edge {index}, from {edge.i} to {edge.j},"
        if not (0 <= edge.i < count and 0 <= edge.j < count and edge.i != edge.j):
            raise ValueError(f"{name} must join two different ones of {count} poses")
        if edge.T_i_j.shape != (4, 4) or edge.covariance.shape != (6, 6):
            raise ValueError(
                f"{name} must have a (4, 4) pose and a (6, 6) covariance, got {edge.T_i_j.shape} and "
                f"{edge.covariance.shape}"
            )
        try:
            np.linalg.cholesky(edge.covariance)
        except np.linalg.LinAlgError:
            raise ValueError(f"{name} has a covariance that is not positive definite:\n{edge.covariance}") from None
    label = connected_parts(count, ((edge.i, edge.j) for edge in edges if not edge.doubtful))
    if label.any():
        loose = np.flatnonzero(label)
        raise ValueError(
            f"{len(loose)} of {count} poses, the first is {loose[0]}, are not connected to pose 0 by edges that are "
            "not doubtful: add the edge to the pose before, with a large covariance if need be"
        )

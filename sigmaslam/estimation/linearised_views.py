"""Views of landmarks, linearised and weighed by machine code that is written from the estimator's torch source.

A graph of a frame's update is some 900 operations on small tensors, each of which costs more than its arithmetic. Here
the function of one view is compiled (`sigmaslam_models.estimator.view_source` writes it), and `frame_steps` and
`window_steps` sum over views by a few products of matrices. What is computed is said in
`sigmaslam_models.estimator.stereo_views`; the results agree to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np

from sigmaslam.estimation.state_layout import CALIBRATION_MODELLED, CALIBRATION_SIZE
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse

_views: ModuleType | None
try:
    _views = import_module("sigmaslam.estimation._views")
except ImportError:  # installed without a compiler
    _views = None

IS_COMPILED = _views is not None
"""Whether a compiler was at hand when the package was installed; else the graphs serve."""
LEAST_SPREAD = 1e-6
"""Of sigma points: share of the scene's depth, radians, pixels; with it alone slopes are derivatives."""
MAX_SPREAD = 0.05
"""Largest standard deviation that sigma points are drawn from: share of the scene's depth and radians."""
UNKNOWN_VARIANCE = 1e12
"""Of a disparity that is not there, pixels squared."""
# Sigma points lie so many variances away: of a cubature of thirteen numbers.
_SPREAD = 13.0

Feed = Mapping[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Slopes:
    """Views, linearised: mean, by_pair, by_landmark, nonlinearity and in_front of `stereo_views.Slopes`.

    Attributes:
        through: (M, 3, 3) what the landmarks' own covariances make of the views.
        chain: (p, 9, n) whitened relative pose and modelled calibration of a pair, by the state.
        pair: (M,) which of these each view belongs to.
    """

    mean: np.ndarray
    by_pair: np.ndarray
    by_landmark: np.ndarray
    nonlinearity: np.ndarray
    through: np.ndarray
    in_front: np.ndarray
    chain: np.ndarray
    pair: np.ndarray

    def by_state(
        self, by_pair: np.ndarray, by_landmark: np.ndarray, dependence: np.ndarray | None = None
    ) -> np.ndarray:
        """(M, 3, n) derivatives by the state.

        Args:
            by_pair, by_landmark: (M, 3, 18), (M, 3, 6), which may have been whitened.
            dependence: (M, 6, n) of the landmarks; they stay by default.
        """
        assert _views is not None
        return np.asarray(_views.by_state(by_pair, self.pair, self.chain, by_landmark, dependence))


def linearise(
    feed: Feed, poses: np.ndarray, calibration: np.ndarray, spread: np.ndarray, landmarks: np.ndarray, own: np.ndarray
) -> Slopes:
    """As `stereo_views.linearise`, by sigma points; `own`: (M, 6, 6) of the landmarks."""
    assert _views is not None
    T_view_world = se3_inverse(poses[feed["views"]])
    depth, count = float(feed["depth"]), len(poses)
    chain = np.zeros((len(T_view_world), 9, CALIBRATION_SIZE + 6 * count))
    adjoint, each = se3_adjoint(T_view_world), np.arange(len(T_view_world))
    by_pose = np.zeros((len(T_view_world), count, 6, 6))
    by_pose[each, feed["anchors"]] += adjoint
    by_pose[each, feed["views"]] -= adjoint
    chain[:, :6, CALIBRATION_SIZE:] = by_pose.transpose(0, 2, 1, 3).reshape(len(each), 6, -1)
    chain[:, 6:, :CALIBRATION_MODELLED] = np.eye(CALIBRATION_MODELLED)
    joint = chain @ spread @ chain.transpose(0, 2, 1)
    joint = (joint + joint.transpose(0, 2, 1)) / 2.0
    variance = np.diagonal(joint, axis1=1, axis2=2)
    worst = np.maximum(variance[:, :3].max(axis=1) / depth**2, variance[:, 3:6].max(axis=1))
    joint *= (MAX_SPREAD**2 / np.maximum(worst, MAX_SPREAD**2))[:, None, None]
    least = np.r_[np.full(3, depth), np.ones(6)] * LEAST_SPREAD
    root = np.linalg.cholesky(joint + np.diag(least**2))
    pairs = _pair_points(T_view_world @ poses[feed["anchors"]], root, calibration[:CALIBRATION_MODELLED])
    seen = _views.see_views(pairs, feed["pair"], calibration, feed["intrinsics"], landmarks, own, feed["common"])
    mean, by_pair, by_landmark, nonlinearity, through, in_front = seen
    whitened = np.linalg.inv(root) @ chain
    return Slopes(mean, by_pair, by_landmark, nonlinearity, through, in_front > 0.0, whitened, feed["pair"])


def _pair_points(relative: np.ndarray, root: np.ndarray, calibration: np.ndarray) -> np.ndarray:
    """(p, 210) as of `stereo_window.pair_points`, in the order that a view's function reads."""
    steps = np.sqrt(_SPREAD) * root.transpose(2, 0, 1)
    moving, biasing = steps[:6], steps[6:, :, 6:]
    moving, biasing = np.concatenate([moving, -moving]), np.concatenate([biasing, -biasing])
    moved = np.concatenate([se3_exp(moving[..., :6]) @ relative, relative[None]])[:, :, :3]
    biased = np.concatenate([moving[..., 6:], biasing]) + calibration
    count = len(relative)
    return np.concatenate(
        [moved.transpose(1, 2, 3, 0).reshape(count, -1), biased.transpose(1, 2, 0).reshape(count, -1)], axis=1
    )


def weigh(measurement: np.ndarray, linear: Slopes, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by pair and landmark and residuals in units of the noise, (M, 3, 25), and numbers of each (M,)."""
    assert _views is not None
    return _views.weigh_views(measurement, linear.mean, noise, linear.by_pair, linear.by_landmark)


def sum_by_landmark(left: np.ndarray, right: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """(L, 6, 6 + n) of each of `count` landmarks the sum over its views of A^T [A, B], A (O, 3, 6) and B (O, 3, n)."""
    assert _views is not None
    return np.asarray(_views.sum_by_landmark(left, right, owner, count))


def student_weight(distance: np.ndarray, count: np.ndarray | float, freedom: float) -> np.ndarray:
    """As `sigmaslam_filters.robust.student_weight`, consistent; 1 for infinite freedom."""
    if np.isinf(freedom):
        return np.ones_like(distance)
    whole = freedom + count
    return whole * whole / ((whole + 2.0) * (freedom + distance))


def chi_square(quantiles: np.ndarray, components: np.ndarray) -> np.ndarray:
    """(M,) quantiles, of a table by degrees of freedom, for 2 or 3 components."""
    return np.where(components > 2.0, quantiles[3], quantiles[2])


def invert(matrix: np.ndarray) -> np.ndarray:
    """Inverses of positive definite matrices (..., n, n), symmetric, as of `sigmaslam_filters.core.plain_factors`."""
    root = 1.0 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    scale = root[..., :, None] * root[..., None, :]
    inverse = np.linalg.inv(matrix * scale) * scale
    return np.asarray((inverse + np.swapaxes(inverse, -1, -2)) / 2.0)

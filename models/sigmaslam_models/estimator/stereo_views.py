"""Views of a window's landmarks by keyframes and frames, statistically linearised about poses and calibration."""

from typing import NamedTuple

import torch
from torch import Tensor

from sigmaslam.estimation.state_layout import CALIBRATION_MODELLED, CALIBRATION_SIZE, MODELLED
from sigmaslam_filters.core.plain_factors import definite_cholesky
from sigmaslam_filters.manifolds.se3_matrices import adjoint_se3, invert_se3
from sigmaslam_models.estimator.calibration_errors import unmodelled_errors, view_turns
from sigmaslam_models.estimator.stereo_window import StereoTransfer

# Least spread of sigma points: share of the scene's depth, radians, pixels; with it alone slopes are derivatives.
LEAST_SPREAD = 1e-6
# Largest standard deviation that sigma points are drawn from: share of the scene's depth and radians.
_MAX_SPREAD = 0.05


class Scene(NamedTuple):
    """What all linearisations of a frame or of a window have in common; M views of landmarks, p pairs of poses.

    Attributes:
        intrinsics: (5,) fx, fy, cx, cy, fx baseline.
        depth: () of the scene, metres.
        unscented: () 1 to linearise by sigma points, 0 by first derivatives.
        anchors, views: (p,) int64, the poses that landmarks are anchored to, and that see them.
        pair: (M,) int64, which of these pairs a view belongs to.
        common: (M, 3, 2) how errors of place that all views of a landmark share enter a view.
        covariance: (M, 6, 6) of the landmark that is seen, given poses and calibration.
    """

    intrinsics: Tensor
    depth: Tensor
    unscented: Tensor
    anchors: Tensor
    views: Tensor
    pair: Tensor
    common: Tensor
    covariance: Tensor


class Slopes(NamedTuple):
    """Views of landmarks, linearised; the derivatives by the state are in two factors.

    Attributes:
        mean: (M, 3) expected (u, v, disparity), without the landmark's errors of place.
        by_pair: (M, 3, 9) derivatives by what `chain` makes of the state, and those by the calibration's other errors,
            (M, 3, 12), side by side: (M, 3, 21).
        by_landmark: (M, 3, 6) derivatives.
        chain: (p, 9, n) whitened relative pose and modelled calibration of a pair, by the state.
        nonlinearity: (M, 3, 3) covariance of what is not linear.
        in_front: (M,) bool, the landmark is in front of the camera.
    """

    mean: Tensor
    by_pair: Tensor
    by_landmark: Tensor
    chain: Tensor
    nonlinearity: Tensor
    in_front: Tensor


def linearise(scene: Scene, poses: Tensor, calibration: Tensor, covariance: Tensor, landmarks: Tensor) -> Slopes:
    """Linearises M views.

    Args:
        scene: what they have in common.
        poses: (K, 4, 4) T_world_camera.
        calibration: (15,) its errors.
        covariance: (15 + 6 K, 15 + 6 K) of calibration and poses, which sigma points are drawn from.
        landmarks: (M, 6) the landmark that each view sees, in its anchor keyframe.
    """
    T_view_world = invert_se3(poses.index_select(0, scene.views))
    chain = _chain(scene, adjoint_se3(T_view_world), poses.shape[0])
    units = torch.cat([scene.depth.expand(3), torch.ones_like(covariance[0, :6])])
    least = torch.tensor(LEAST_SPREAD, dtype=poses.dtype, device=poses.device)
    joint = scene.unscented * (chain @ covariance @ chain.mT)
    spread = definite_cholesky(_limited((joint + joint.mT) / 2.0, scene.depth) + torch.diag(units * least) ** 2)
    own = scene.unscented * scene.covariance[:, :MODELLED, :MODELLED]
    identity = torch.eye(MODELLED, dtype=poses.dtype, device=poses.device)
    landmark_spread = definite_cholesky(own + identity * (least * least))
    mean, slopes, nonlinearity, in_front = StereoTransfer()(
        T_view_world @ poses.index_select(0, scene.anchors),
        spread,
        scene.pair,
        calibration[:CALIBRATION_MODELLED],
        scene.intrinsics,
        landmarks[:, :MODELLED],
        landmark_spread,
    )
    by_landmark = slopes[:, :, 9:] @ torch.linalg.inv_ex(landmark_spread).inverse
    # A pair that is off sees each point as the calibrated pair sees another one, in the anchor and in the view.
    in_anchor, in_view = unmodelled_errors(scene.intrinsics, torch.stack([landmarks[:, :3], mean])).unbind(0)
    # Following goes on from keyframe to keyframe, and so does its error.
    followed = (scene.views - scene.anchors).to(poses.dtype).index_select(0, scene.pair)
    turns = view_turns(scene.intrinsics, mean) * followed[:, None, None]
    by_error = torch.cat([in_view - by_landmark[:, :, :3] @ in_anchor, turns], dim=2)
    shift = by_error.flatten(0, 1) @ calibration[CALIBRATION_MODELLED:, None]
    return Slopes(
        mean + shift.unflatten(0, (-1, 3))[..., 0],
        torch.cat([slopes[:, :, :9], by_error], dim=2),
        torch.cat([by_landmark, scene.common], dim=2),
        torch.linalg.inv_ex(spread).inverse @ chain,
        nonlinearity,
        in_front > 0.0,
    )


def by_state(by_pair: Tensor, chain: Tensor, pair: Tensor) -> Tensor:
    """Derivatives by the state, (3 M, n), from the factors of `Slopes`, of which the first may have been whitened."""
    pairs = torch.arange(chain.shape[0], device=chain.device)
    mine = (pair[:, None] == pairs).to(chain.dtype)[:, None, :, None]
    by_all_pairs = (by_pair[:, :, None, :9] * mine).flatten(2)
    errors = torch.eye(CALIBRATION_SIZE, dtype=chain.dtype, device=chain.device)[CALIBRATION_MODELLED:]
    errors = torch.nn.functional.pad(errors, (0, chain.shape[2] - CALIBRATION_SIZE))
    return torch.cat([by_all_pairs, by_pair[:, :, 9:]], dim=2).flatten(0, 1) @ torch.cat([chain.flatten(0, 1), errors])


def _chain(scene: Scene, adjoint: Tensor, count: int) -> Tensor:
    """How relative poses and modelled errors of the calibration follow from the state, (p, 9, n)."""
    numbers = torch.arange(count, device=adjoint.device)
    difference = (scene.anchors[:, None] == numbers).to(adjoint.dtype) - (scene.views[:, None] == numbers).to(
        adjoint.dtype
    )
    relative = (adjoint[:, :, None, :] * difference[:, None, :, None]).flatten(2)
    relative = torch.nn.functional.pad(relative, (CALIBRATION_SIZE, 0))
    modelled = torch.eye(CALIBRATION_MODELLED, dtype=adjoint.dtype, device=adjoint.device)
    modelled = torch.nn.functional.pad(modelled, (0, CALIBRATION_SIZE - CALIBRATION_MODELLED + 6 * count))
    return torch.cat([relative, modelled.expand(adjoint.shape[0], -1, -1)], dim=1)


def _limited(covariance: Tensor, depth: Tensor) -> Tensor:
    """Covariances (p, 9, 9) of relative poses and calibration, shrunk where sigma points would leave the scene."""
    variance = torch.diagonal(covariance, dim1=1, dim2=2)
    worst = torch.maximum(variance[:, :3].amax(dim=1) / (depth * depth), variance[:, 3:6].amax(dim=1))
    most = torch.tensor(_MAX_SPREAD**2, dtype=covariance.dtype, device=covariance.device)
    return covariance * (most / torch.maximum(worst, most))[:, None, None]

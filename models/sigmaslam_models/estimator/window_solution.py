"""The joint solution of a window of keyframes: landmarks eliminated from the equations of the state, then Gauss-Newton.

Each landmark is eliminated by its own equations (Schur's complement), so that every measurement counts once and a
landmark's error is shared by all its views.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.state_layout import LANDMARK_SIZE, MODELLED
from sigmaslam_filters.core.plain_factors import invert
from sigmaslam_filters.core.unrolled_factors import whiten
from sigmaslam_filters.robust import student_weight
from sigmaslam_models.estimator.residuals import UNKNOWN_VARIANCE, chi_square, mask_missing
from sigmaslam_models.estimator.stereo_views import Scene, Slopes, by_state, linearise


class WindowViews(NamedTuple):
    """Views of L landmarks by K keyframes, O views in all, n = 15 + 6 K, at the posterior.

    Attributes:
        intrinsics, depth, unscented, anchors, views, pair, common: as of `stereo_views.Scene`, for O views.
        owner: (O,) int64, which of the landmarks a view sees.
        estimate, covariance: (L, 6), (L, 6, 6) of the landmarks given poses and calibration.
        poses: (K, 4, 4) T_world_camera.
        calibration: (15,) its errors.
        spread: (n, n) covariance of both, which sigma points are drawn from.
        measurement: (O, 3) (u, v, disparity), NaN for a missing disparity.
        noise: (O, 3, 3) covariance of a view's own errors.
    """

    intrinsics: Tensor
    depth: Tensor
    unscented: Tensor
    anchors: Tensor
    views: Tensor
    pair: Tensor
    common: Tensor
    owner: Tensor
    estimate: Tensor
    covariance: Tensor
    poses: Tensor
    calibration: Tensor
    spread: Tensor
    measurement: Tensor
    noise: Tensor

    def linearise(self) -> tuple[Slopes, Tensor, Tensor, Tensor]:
        """Slopes, residuals (O, 3), their noise (O, 3, 3), and how many numbers each has (O,)."""
        landmarks = self.estimate.index_select(0, self.owner)
        scene = Scene(*self[:7], self.covariance.index_select(0, self.owner))
        linear = linearise(scene, self.poses, self.calibration, self.spread, landmarks)
        mean = linear.mean + (self.common @ landmarks[:, MODELLED:, None])[..., 0]
        return linear, *mask_missing(self.measurement, mean, self.noise + linear.nonlinearity)


class GateWindow(nn.Module):
    """Which views fit the posterior (99.9 %).

    Shapes:
        fields of `WindowViews` -> (O,) bool.
    """

    def forward(self, *views: Tensor) -> Tensor:
        """By the length of each view's residual."""
        return agreeing(WindowViews(*views))


class EliminateLandmarks(nn.Module):
    """What the views say of the state, every landmark solved for it.

    Shapes:
        measured, variance (L, 6) of the landmarks in their anchor keyframes, freedom () of the Student-t, fields of
        `WindowViews` -> information (n, n) and vector (n,) of the state at the posterior, and of the landmarks given
        the state: covariance (L, 6, 6), dependence (L, 6, n) how they move with it, step (L, 6) to their best places
        if it stays.
    """

    def forward(self, measured: Tensor, variance: Tensor, freedom: Tensor, *views: Tensor) -> tuple[Tensor, ...]:
        """By Schur's complement of each landmark."""
        window = WindowViews(*views)
        rows, by_landmark = whitened(window, freedom)
        size = rows.shape[1] - 1
        right = torch.cat([by_landmark, rows.unflatten(0, (-1, 3))], dim=2)
        products = by_landmark.mT @ right
        sums = torch.zeros_like(products[:1]).expand(measured.shape[0], -1, -1)
        sums = sums.index_put((window.owner,), products, accumulate=True)
        departure = measured - window.estimate
        precision = _prior_precision(departure, variance, freedom)
        inverse = invert(sums[:, :, :LANDMARK_SIZE] + torch.diag_embed(precision))
        prior = torch.nn.functional.pad((departure * precision)[..., None], (size, 0))
        sums = sums[:, :, LANDMARK_SIZE:] + prior
        solved = inverse @ sums
        whole = rows.mT @ rows - sums.flatten(0, 1).mT @ solved.flatten(0, 1)
        return whole[:size, :size], whole[:size, size], inverse, -solved[:, :, :size], solved[:, :, size]


class Condition(nn.Module):
    """Posterior of a state of which something is learned; the prior may be singular.

    Shapes:
        factor (n, k) of the prior covariance, factor factor^T, information (n, n) and vector (n,) of the likelihood
        exp(-x^T information x / 2 + vector^T x) for x from the prior's mean, common (n, 15) how considered errors enter
        the state -> mean (n,), covariance (n, n), common (n, 15), by the same gain.
    """

    def forward(self, factor: Tensor, information: Tensor, vector: Tensor, common: Tensor) -> tuple[Tensor, ...]:
        """In units of the prior."""
        identity = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
        whole = identity + factor.mT @ information @ factor
        covariance = factor @ invert((whole + whole.mT) / 2.0) @ factor.mT
        learned = torch.cat([vector[:, None], -information @ common], dim=1)
        moved = covariance @ learned
        return moved[:, 0], covariance, common + moved[:, 1:]


def agreeing(window: WindowViews) -> Tensor:
    """(O,) bool, the views whose residuals are no longer than 99.9 % are."""
    linear, residual, noise, components = window.linearise()
    white = whiten(residual[..., None], noise)[..., 0]
    return linear.in_front & ((white * white).sum(dim=1) <= chi_square(CHI_SQUARE_999, components))


def whitened(window: WindowViews, freedom: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted and in units of their noise: derivatives by the state, the residuals behind them (3 O, n + 1), and
    derivatives by the landmarks (O, 3, 6)."""
    linear, residual, noise, components = window.linearise()
    identity = torch.eye(3, dtype=noise.dtype, device=noise.device)
    unknown = torch.tensor(UNKNOWN_VARIANCE, dtype=noise.dtype, device=noise.device)
    noise = torch.where(linear.in_front[:, None, None], noise, unknown * identity)
    stacked = whiten(torch.cat([linear.by_pair, linear.by_landmark, residual[..., None]], dim=2), noise)
    squared = (stacked[..., -1] * stacked[..., -1]).sum(dim=1)
    weight = student_weight(squared, components, freedom, consistent=True)
    stacked = stacked * torch.sqrt(weight)[:, None, None]
    rows = by_state(stacked[..., :-7], linear.chain, window.pair)
    return torch.cat([rows, stacked[..., -1].flatten()[:, None]], dim=1), stacked[..., -7:-1]


def _prior_precision(departure: Tensor, variance: Tensor, freedom: Tensor) -> Tensor:
    """(L, 6) precisions of landmarks as measured, by how far (L, 6) their estimates are from there.

    What their views share has longer tails than a Gaussian's, too: a place where two surfaces meet in the image is
    wrong in all views alike.
    """
    precision = 1.0 / variance
    squared = departure * departure * precision
    disparity = student_weight(squared[:, 3:MODELLED].sum(dim=1), 1.0, freedom, consistent=True)
    place = student_weight(squared[:, MODELLED:].sum(dim=1), 2.0, freedom, consistent=True)
    weights = [torch.ones_like(precision[:, :3]), disparity[:, None], place[:, None].expand(-1, 2)]
    return precision * torch.cat(weights, dim=1)

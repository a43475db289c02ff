"""The update of one frame's pose against a window of keyframes: prediction of its views, robust steps, gated steps.

The state is that of the window, n - 6 numbers, and the frame's pose behind it. It is estimated in units of its prior:
offset = factor z with z ~ N(0, I), so that a prior of any rank will do and no covariance is ever inverted.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, LANDMARK_SIZE, MODELLED
from sigmaslam_filters.core.plain_factors import invert
from sigmaslam_filters.core.unrolled_factors import whiten
from sigmaslam_filters.manifolds.se3_matrices import exp_se3
from sigmaslam_filters.robust import common_scale, student_weight
from sigmaslam_models.estimator.residuals import UNKNOWN_VARIANCE, chi_square, mask_missing
from sigmaslam_models.estimator.stereo_views import Scene, Slopes, by_state, linearise

# Scales of the robust loss by which a frame's pose is first found, in standard deviations: it narrows.
ROBUST_SCALES = (6.0, 4.0, 3.0)
# Of the factor by which all variances of a frame together are too small, see `common_scale`.
NOISE_SCALE_RULES = ACCEPTANCE.scaled_agreement, ACCEPTANCE.max_noise_scale


class FrameViews(NamedTuple):
    """What a frame sees, and what is known before; K keyframes and the frame, n = 15 + 6 K + 6, M views.

    Attributes:
        intrinsics, depth, unscented, anchors, views, pair, common, covariance: as of `stereo_views.Scene`.
        estimate: (M, 6) the landmark that is seen, in its anchor keyframe.
        dependence: (M, 6, n) how it moves with the state; not with the frame's pose.
        poses: (K + 1, 4, 4) T_world_camera of the window's posterior, and as expected of the frame.
        calibration: (15,) its errors, of the window's posterior.
        factor: (n, k) of the prior covariance, factor factor^T.
    """

    intrinsics: Tensor
    depth: Tensor
    unscented: Tensor
    anchors: Tensor
    views: Tensor
    pair: Tensor
    common: Tensor
    covariance: Tensor
    estimate: Tensor
    dependence: Tensor
    poses: Tensor
    calibration: Tensor
    factor: Tensor

    def linearise(self, offset: Tensor, spread: Tensor, moved: Tensor) -> Slopes:
        """The views at a state `offset` (n,) from the prior's mean, landmarks `moved` (M, 6) from where it has them.

        Args:
            offset, moved: see above.
            spread: (n, n) covariance that sigma points are drawn from.
        """
        poses = exp_se3(offset[CALIBRATION_SIZE:].unflatten(0, (-1, 6))) @ self.poses
        shift = self.dependence.flatten(0, 1) @ offset[:, None]
        landmarks = self.estimate + shift.unflatten(0, (-1, LANDMARK_SIZE))[..., 0] + moved
        linear = linearise(Scene(*self[:8]), poses, self.calibration + offset[CALIBRATION], spread, landmarks)
        # As seen without the move, which the state's and the landmark's errors explain together.
        expected = torch.nn.functional.pad(landmarks[:, MODELLED:], (MODELLED, 0)) - moved
        return linear._replace(mean=linear.mean + (linear.by_landmark @ expected[..., None])[..., 0])

    def by_state(self, by_pair: Tensor, by_landmark: Tensor, chain: Tensor) -> Tensor:
        """(3 M, n) derivatives by the state, also through the landmarks."""
        return by_state(by_pair, chain, self.pair) + (by_landmark @ self.dependence).flatten(0, 1)


class _Whitened(NamedTuple):
    """The views of a frame at one linearisation point, in units of their noise and of the prior.

    Attributes:
        by_state, by_landmark: (3 M, n), (M, 3, 6) derivatives.
        by_prior: (3 M, k) derivatives by z.
        beyond: (3 M, 1) measured less what the prior's mean makes of it, zero for what is missing.
        residual: (M, 3) of them what the linearisation point leaves.
        squared: (M,) squared length of the residual.
        components: (M,) how many numbers it has.
        usable: (M,) bool, in front of the camera and anywhere near.
    """

    by_state: Tensor
    by_landmark: Tensor
    by_prior: Tensor
    beyond: Tensor
    residual: Tensor
    squared: Tensor
    components: Tensor
    usable: Tensor


class PredictViews(nn.Module):
    """Where a frame should see landmarks.

    Shapes:
        fields of `FrameViews` -> (u, v, disparity) (M, 3), its covariance without the measurement's noise (M, 3, 3),
        in_front (M,) bool.
    """

    def forward(self, *views: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """At the prior's mean, over the prior."""
        frame = FrameViews(*views)
        zero = torch.zeros_like(frame.factor[:, 0])
        mean, by_state, _, noise, in_front = predicted(frame, zero, frame.factor @ frame.factor.mT)
        by_prior = (by_state @ frame.factor).unflatten(0, (-1, 3))
        return mean, noise + by_prior @ by_prior.mT, in_front > 0.0


class RobustStep(nn.Module):
    """One linearisation with a robust loss that narrows.

    Shapes:
        measurement (M, 3) with NaN for a missing disparity, noise (M, 3, 3), offset (n,), spread (n, n), moved (M, 6),
        gated () 1 to weigh residuals first by what the prior expects of them, scale () how much smaller than claimed
        the variances are by which views are told to agree, fields of `FrameViews` -> offset (n,), spread (n, n), moved
        (M, 6) after the step, number of usable views ().
    """

    def forward(
        self,
        measurement: Tensor,
        noise: Tensor,
        offset: Tensor,
        spread: Tensor,
        moved: Tensor,
        gated: Tensor,
        scale: Tensor,
        *views: Tensor,
    ) -> tuple[Tensor, ...]:
        """Three weighted solutions of the same linear system."""
        frame = FrameViews(*views)
        seen = linearised(frame, measurement, noise, offset, spread, moved)
        # About what the prior expects.
        slopes = seen.by_prior.unflatten(0, (-1, 3))
        innovation = slopes @ slopes.mT + torch.eye(3, dtype=noise.dtype, device=noise.device)
        whitened = whiten(seen.residual[..., None], innovation)
        squared = torch.where(gated > 0.0, _lengths(whitened[..., 0]), seen.squared)
        usable = seen.usable.to(noise.dtype)
        z, inverse, after = seen.beyond, spread, seen.residual
        for limit in ROBUST_SCALES:
            loss = 1.0 + squared / (scale * (limit * limit))
            weight = usable / (loss * loss)
            z, inverse = _solve(seen, weight)
            after = (seen.beyond - seen.by_prior @ z).unflatten(0, (-1, 3))[..., 0]
            squared = _lengths(after)
        return (
            (frame.factor @ z)[:, 0],
            frame.factor @ inverse @ frame.factor.mT,
            _landmark_step(frame, seen.by_landmark, after),
            usable.sum(),
        )


class GatedStep(nn.Module):
    """One linearisation with a gate, and weights of a Student-t for what passes it.

    Shapes:
        measurement (M, 3), noise (M, 3, 3), offset (n,), spread (n, n), moved (M, 6), noise_scale () what the variances
        of all views are multiplied by, zero to find it, scale () as of `RobustStep`, freedom () of the Student-t, prior
        (n, 15) how considered errors enter the state, fields of `FrameViews` ->
        agree (M,) bool, of the usable views those that pass, their number (), number of usable views (), squared (M,)
        lengths of the residuals, noise_scale (), and after the step: offset (n,), spread (n, n), moved (M, 6), common
        (n, 15), information (n, n) of the views, scores (M, 6) slope of each view's log-likelihood by the frame's pose,
        score (n,) slope of all views' by the state, cost () of the prior.
    """

    def forward(
        self,
        measurement: Tensor,
        noise: Tensor,
        offset: Tensor,
        spread: Tensor,
        moved: Tensor,
        noise_scale: Tensor,
        scale: Tensor,
        freedom: Tensor,
        prior: Tensor,
        *views: Tensor,
    ) -> tuple[Tensor, ...]:
        """The gate before the step, which the caller takes or leaves."""
        frame = FrameViews(*views)
        seen = linearised(frame, measurement, noise, offset, spread, moved)
        median, largest = (chi_square(table, seen.components) for table in (CHI_SQUARE_MEDIAN, CHI_SQUARE_999))
        found = common_scale(seen.squared, median, largest, seen.usable, *NOISE_SCALE_RULES)
        noise_scale = torch.where(noise_scale > 0.0, noise_scale, found)
        squared = seen.squared / noise_scale
        agree = seen.usable & (squared <= scale * largest)
        passed = agree.to(noise.dtype)
        weight = passed * student_weight(squared, seen.components, freedom, consistent=True) / noise_scale
        z, inverse = _solve(seen, weight)
        posterior = frame.factor @ inverse @ frame.factor.mT
        after = seen.beyond - seen.by_prior @ z
        weighted = seen.by_state * _each_row(weight)
        information = weighted.mT @ seen.by_state
        scores = (weighted[:, -6:] * after).unflatten(0, (-1, 3)).sum(dim=1)
        return (
            agree,
            passed.sum(),
            seen.usable.to(noise.dtype).sum(),
            squared,
            noise_scale,
            (frame.factor @ z)[:, 0],
            posterior,
            _landmark_step(frame, seen.by_landmark, (after / noise_scale).unflatten(0, (-1, 3))[..., 0]),
            prior - posterior @ (information @ prior),
            information,
            scores,
            (weighted.mT @ after)[:, 0],
            (z * z).sum(),
        )


def update_frame(
    measurement: Tensor, noise: Tensor, frame: FrameViews, freedom: Tensor, robust: int = 2, gated: int = 3
) -> tuple[Tensor, Tensor, Tensor]:
    """The whole update as the run time makes it, in torch: for gradients, and for batches by `torch.func.vmap`.

    Args:
        measurement: (M, 3) (u, v, disparity), NaN for a missing disparity.
        noise: (M, 3, 3) covariance of a view's own errors.
        frame: what is seen, and the prior.
        freedom: () degrees of freedom of the errors' Student-t.
        robust, gated: how many linearisations there are with a robust loss, and at most with a gate.
    Returns:
        (n,) mean of the state, from the prior's; (n, n) its covariance; (M,) bool, the views that pass the gate.
    """
    zero, one = torch.zeros_like(frame.depth), torch.ones_like(frame.depth)
    offset, spread = torch.zeros_like(frame.factor[:, 0]), frame.factor @ frame.factor.mT
    moved = torch.zeros_like(frame.estimate)
    for k in range(robust):
        first = one if k == 0 else zero
        offset, spread, moved, _ = RobustStep()(measurement, noise, offset, spread, moved, first, one, *frame)
    scale, nothing = zero, frame.factor[:, :0]
    inliers = settled = torch.zeros_like(measurement[:, 0], dtype=torch.bool)
    for k in range(gated):
        agree, _, _, _, scale, *step = GatedStep()(
            measurement, noise, offset, spread, moved, scale, one, freedom, nothing, *frame
        )
        if k > 0:
            settled = settled | (agree == inliers).all()
        if k < gated - 1:  # the last one is the gate alone
            taken = settled[0]
            offset, spread, moved = (
                torch.where(taken, before, after)
                for before, after in zip((offset, spread, moved), step[:3], strict=True)
            )
            inliers = torch.where(taken, inliers, agree)
    return offset, spread, inliers & agree


def predicted(frame: FrameViews, offset: Tensor, spread: Tensor) -> tuple[Tensor, ...]:
    """What a frame should see: mean (M, 3), derivatives by the state (3 M, n) and by the landmarks (M, 3, 6), what they
    leave uncertain (M, 3, 3), and 1.0 for what is in front (M,)."""
    linear = frame.linearise(offset, spread, torch.zeros_like(frame.estimate))
    by_state = frame.by_state(linear.by_pair, linear.by_landmark, linear.chain)
    through = linear.by_landmark @ frame.covariance @ linear.by_landmark.mT
    in_front = linear.in_front.to(offset.dtype)
    return linear.mean, by_state, linear.by_landmark, linear.nonlinearity + through, in_front


def linearised(
    frame: FrameViews, measurement: Tensor, noise: Tensor, offset: Tensor, spread: Tensor, moved: Tensor
) -> _Whitened:
    """What a frame sees, at an offset of the state and landmarks that moved."""
    linear = frame.linearise(offset, spread, moved)
    through = linear.by_landmark @ frame.covariance @ linear.by_landmark.mT
    residual, noise, components = mask_missing(measurement, linear.mean, noise + linear.nonlinearity + through)
    pieces = [linear.by_pair, linear.by_landmark, residual[..., None]]
    stacked = whiten(torch.cat(pieces, dim=2), noise)
    by_pair, by_landmark, residual = stacked[..., :-7], stacked[..., -7:-1], stacked[..., -1]
    derivatives = frame.by_state(by_pair, by_landmark, linear.chain)
    squared = _lengths(residual)
    anywhere = torch.tensor(UNKNOWN_VARIANCE, dtype=noise.dtype, device=noise.device)
    usable = linear.in_front & (squared < anywhere)
    along = derivatives @ torch.cat([frame.factor, offset[:, None]], dim=1)
    beyond = residual.flatten()[:, None] + along[:, -1:]
    return _Whitened(derivatives, by_landmark, along[:, :-1], beyond, residual, squared, components, usable)


def _solve(seen: _Whitened, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (k, 1) and covariance (k, k) of z ~ N(0, I) given the views, weighted (M,)."""
    weighted = seen.by_prior * _each_row(weight)
    identity = torch.eye(seen.by_prior.shape[1], dtype=weight.dtype, device=weight.device)
    inverse = invert(weighted.mT @ seen.by_prior + identity)
    return inverse @ (weighted.mT @ seen.beyond), inverse


def _each_row(weight: Tensor) -> Tensor:
    """(3 M, 1) of (M,)."""
    return weight[:, None].expand(-1, 3).flatten()[:, None]


def _landmark_step(frame: FrameViews, by_landmark: Tensor, after: Tensor) -> Tensor:
    """(M, 6) how far the landmarks move for residuals (M, 3) after the state's step; whitened."""
    return (frame.covariance @ (by_landmark.mT @ after[..., None]))[..., 0]


def _lengths(residual: Tensor) -> Tensor:
    """(M,) squared lengths of (M, 3)."""
    return (residual * residual).sum(dim=-1)

"""What one view of a landmark is worth, view by view: what `compiled_views` writes as C++.

The same functions as in the graphs, for arrays that begin with the views (B, ...): of each view its own copy of all
that it depends on. What is done for a pair of poses, and sums over views, stands in
`sigmaslam.estimation.compiled_views`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sigmaslam.estimation.linearised_views import LEAST_SPREAD
from sigmaslam.estimation.state_layout import CALIBRATION_MODELLED, MODELLED
from sigmaslam_filters.core.plain_factors import definite_cholesky, solve_lower_transposed
from sigmaslam_filters.core.unrolled_factors import apply, multiply, whiten
from sigmaslam_models.estimator.calibration_errors import unmodelled_errors
from sigmaslam_models.estimator.residuals import mask_missing
from sigmaslam_models.estimator.stereo_window import transfer

# Numbers of a pair of poses: twelve entries of thirteen poses, three of eighteen calibrations.
PAIR = 12 * 13 + 3 * 18


def see(
    pair: Tensor, calibration: Tensor, intrinsics: Tensor, landmark: Tensor, covariance: Tensor, common: Tensor
) -> tuple[Tensor, ...]:
    """A view, linearised: `stereo_views.linearise`.

    Args:
        pair: (B, 210) entries of `stereo_window.pair_points`: poses (12, 13), calibrations (3, 18).
        calibration, intrinsics: (B, 12), (B, 5), the same for all.
        landmark, covariance: (B, 6), (B, 6, 6), its covariance given the state; the linearisation's spread.
        common: (B, 3, 2).
    Returns:
        Of `stereo_views.Slopes`: mean (B, 3), by_pair (B, 3, 18), by_landmark (B, 3, 6), nonlinearity (B, 3, 3); what
        the landmark's covariance makes of the view (B, 3, 3), and in_front (B,) 1.0 or 0.0.
    """
    poses = pair[:, : 12 * 13].mT.unflatten(0, (12, 13)).unbind(0)
    biases = pair[:, 12 * 13 :].mT.unflatten(0, (3, 18))
    least = torch.eye(MODELLED, dtype=pair.dtype) * (LEAST_SPREAD * LEAST_SPREAD)
    spread = definite_cholesky(covariance[:, :MODELLED, :MODELLED] + least)
    errors, own = calibration.mT, landmark[:, :MODELLED].mT
    mean, slopes, uneven, in_front = transfer(
        poses, biases, errors[:CALIBRATION_MODELLED], intrinsics.mT, own, spread.permute(1, 2, 0)
    )
    by_landmark = solve_lower_transposed(spread, slopes[:, :, 9:].mT).mT
    in_anchor, in_view = (unmodelled_errors(intrinsics.mT, each) for each in (landmark[:, :3], mean))
    by_error = in_view - multiply(by_landmark[:, :, :3], in_anchor)
    shift = apply(by_error, calibration[:, CALIBRATION_MODELLED:])
    by_pair, by_landmark = torch.cat([slopes[:, :, :9], by_error], dim=2), torch.cat([by_landmark, common], dim=2)
    through = multiply(multiply(by_landmark, covariance), by_landmark.mT)
    return mean + shift, by_pair, by_landmark, multiply(uneven, uneven.mT), through, in_front


def weigh(
    measurement: Tensor, mean: Tensor, noise: Tensor, by_pair: Tensor, by_landmark: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives by pair and landmark, and the residual, in units of the noise.

    Args:
        measurement, mean, noise: (B, 3) with NaN for a missing disparity, (B, 3), (B, 3, 3).
        by_pair, by_landmark: (B, 3, 18), (B, 3, 6).
    Returns:
        (B, 3, 25) side by side, and (B,) how many numbers the residual has.
    """
    residual, noise, components = mask_missing(measurement, mean, noise)
    return whiten(torch.cat([by_pair, by_landmark, residual[..., None]], dim=2), noise), components.to(noise.dtype)

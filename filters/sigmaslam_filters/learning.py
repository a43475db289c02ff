"""Noise by expectation maximisation; for any other parameter maximise the track's likelihood."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters.bayes import BayesFilter, UnscentedKalmanFilter
from sigmaslam_filters.core.factors import square
from sigmaslam_filters.core.noise_covariance import as_noise
from sigmaslam_filters.core.tensors import Inputs, as_inputs
from sigmaslam_filters.core.transforms import Unscented
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import AnyMeasurement, AnyMotion, LinearMeasurement, is_additive


@dataclass(frozen=True, slots=True, eq=False)
class FittedNoise:
    """What `fit_noise` returns.

    Attributes:
        motion: with the process noise found.
        measurement: with the measurement noise found.
        log_likelihood: (K,) of the values before each step; of linear models it never falls.
    """

    motion: AnyMotion
    measurement: AnyMeasurement
    log_likelihood: Tensor


def fit_noise(
    belief: Gaussian,
    motion: AnyMotion,
    measurement: AnyMeasurement,
    values: Tensor,
    steps: int = 50,
    motion_inputs: Inputs = (),
    measurement_inputs: Inputs = (),
    *,
    bayes: BayesFilter | None = None,
) -> FittedNoise:
    """Q and R, dense, that make measured sequences likelier (Shumway & Stoffer 1982), all other parts kept.

    Expectations of nonlinear models are those of sigma points.

    Args:
        belief: at the time of the first measurement, before it; batch (...,).
        motion: its noise, which is added as it is, is the start.
        measurement: likewise.
        values: (T, ..., m) with T > 1, sequences (...,) of one noise; NaN for what is missing.
        steps: of expectation maximisation.
        motion_inputs, measurement_inputs: as `BayesFilter.filter`.
        bayes: a filter in R^n; None: unscented.
    Raises:
        TypeError: the filter is on a manifold.
        ValueError: a noise is not additive, the motion has a noise matrix, or there is nothing to fit.
    """
    if steps < 1 or len(values) < 2 or torch.isnan(values).all():
        raise ValueError("noise is fitted to two measurements or more, of which one is there, in a step or more")
    if motion.noise_matrix is not None or not (is_additive(motion) and is_additive(measurement)):
        raise ValueError("noise is fitted to models that add it, without noise_matrix")
    bayes = UnscentedKalmanFilter() if bayes is None else bayes
    bayes.linearisation.require_flat("fit_noise")
    moving, seeing = as_inputs(motion_inputs), as_inputs(measurement_inputs)
    batch = torch.broadcast_shapes(belief.batch_shape, values.shape[1:-1])
    values = _with_batch(values, batch).expand(-1, *batch, -1)
    present = ~torch.isnan(values)
    if measurement.mask is not None:
        present = present & measurement.mask
    measured = present.any(dim=-1)
    residual = None if isinstance(measurement, LinearMeasurement) else measurement.residual
    moved_by, seen_by = (tuple(_with_batch(each, batch) for each in given) for given in (moving, seeing))
    size, likelihood = belief.size, []
    for _ in range(steps):
        track = bayes.filter(belief, motion, measurement, values, moving, seeing)
        likelihood.append(track.log_likelihood.sum().detach())
        smoothed = bayes.smooth(track)
        root, later, earlier = track.filtered[:-1].factor, smoothed[1:], smoothed[:-1]
        moved = bayes.linearisation.motion(
            track.filtered.mean[:-1], root, motion, as_noise(motion.noise), tuple(moved_by)
        )
        gain = torch.linalg.solve(track.predicted.covariance[1:], moved.columns.odd @ root.mT).mT
        cross = gain @ later.covariance
        rows = torch.cat([earlier.covariance, cross], dim=-1), torch.cat([cross.mT, later.covariance], dim=-1)
        pairs = Gaussian(torch.cat([earlier.mean, later.mean], dim=-1), torch.cat(rows, dim=-2), is_symmetric=True)

        def move(pair: Tensor, motion: AnyMotion = motion) -> Tensor:
            return pair[..., size:] - motion.evaluate(pair[..., :size], *moved_by)

        def left(state: Tensor, measurement: AnyMeasurement = measurement) -> Tensor:
            seen, given = measurement.evaluate(state, *seen_by), torch.where(present, values, 0.0)
            return torch.where(present, given - seen if residual is None else residual(given, seen), 0.0)

        Q, R = _squared(move, pairs), as_noise(measurement.noise).covariance()
        # What is missing has the noise that the rest of its value lets expect.
        told = torch.where(present.unsqueeze(-2), R, 0.0)
        told = torch.linalg.solve(as_noise(measurement.noise).masked(present).covariance(), told.mT).mT
        shown = told @ _squared(left, smoothed) @ told.mT + R - told @ torch.where(present.unsqueeze(-1), R, 0.0)
        R = shown[measured].mean(dim=0)
        motion = replace(motion, noise=Q.flatten(0, -3).mean(dim=0))
        measurement = replace(measurement, noise=0.5 * (R + R.mT))
    return FittedNoise(motion, measurement, torch.stack(likelihood))


def _with_batch(given: Tensor, batch: torch.Size) -> Tensor:
    """(T, ·) of all elements as (T, 1, ·)."""
    return given[(slice(None), *[None] * (len(batch) + 2 - given.ndim))]


def _squared(function: Callable[[Tensor], Tensor], belief: Gaussian) -> Tensor:
    """Expected d d^T (..., m, m) of a function's values d (k, ..., m)."""
    seen = Unscented()(lambda offsets: function(belief.mean + offsets), belief.factor, None)
    return square([*seen.columns.all(), seen.mean.unsqueeze(-1)])

"""Whole sequences: filtering, and Rauch-Tung-Striebel smoothing by square roots, on manifolds too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sigmaslam.filters.failure import FilterError
from sigmaslam.filters.gaussian_belief import Gaussian
from sigmaslam.filters.linalg.square_roots import apply, multiply, solve_lower_transposed, square, triangularise
from sigmaslam.filters.models import AnyMeasurement, AnyMotion
from sigmaslam.filters.results import TimeUpdate, Update
from sigmaslam.filters.tensors import require_tensor

if TYPE_CHECKING:
    from sigmaslam.filters.bayes import BayesFilter


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A filtered sequence; time is the first dimension of everything.

    Attributes:
        predicted: beliefs before each measurement, (T, ...).
        filtered: beliefs after each measurement, (T, ...).
        innovation: (T, ..., m).
        nis: (T, ...), with `count` degrees of freedom.
        count: (T, ...) components that took part.
        log_likelihood: (T, ...) of each measurement given those before; its sum is that of the sequence.
        healthy: (T, ...) bool, False where the policy on failure had to act.
    """

    predicted: Gaussian
    filtered: Gaussian
    innovation: Tensor
    nis: Tensor
    count: Tensor
    log_likelihood: Tensor
    healthy: Tensor
    _predictions: Sequence[TimeUpdate] = field(repr=False)


def filter_sequence(
    bayes: BayesFilter,
    belief: Gaussian,
    motion: AnyMotion,
    measurement: AnyMeasurement,
    values: Tensor,
    motion_inputs: Sequence[Tensor] = (),
    measurement_inputs: Sequence[Tensor] = (),
) -> Track:
    """Update, predict, update, ...: T measurements and the T - 1 motions between them.

    Args:
        bayes: a Kalman, extended or unscented filter.
        belief: at the time of the first measurement, before it; batch (...,), to which that of the values broadcasts,
            or the other way round.
        motion: the same for all steps, but for its inputs.
        measurement: the same for all steps, but for its inputs.
        values: (T, ..., m); NaN for what is missing.
        motion_inputs: (T - 1, ...) each: element k moves step k to k + 1.
        measurement_inputs: (T, ...) each.
    Raises:
        FilterError: as `predict` and `update`; the message begins with the step.
        ValueError: lengths do not fit.
    """
    require_tensor("values", values)
    steps = values.shape[0] if values.ndim else 0
    if values.ndim < 2 or steps == 0:
        raise ValueError(f"values (T, ..., m) with T > 0 expected, got {tuple(values.shape)}")
    for inputs, length, name in ((motion_inputs, steps - 1, "motion"), (measurement_inputs, steps, "measurement")):
        if any(len(given) != length for given in inputs):
            lengths = ", ".join(str(len(given)) for given in inputs)
            raise ValueError(f"{steps} measurements need {name} inputs of length {length}, got {lengths}")
    batch = values.shape[1:-1]
    if belief.batch_shape != batch:
        belief = belief.expand(torch.broadcast_shapes(belief.batch_shape, batch))
    predictions: list[TimeUpdate] = []
    predicted: list[Gaussian] = [belief]
    updates: list[Update] = []
    for k in range(steps):
        try:
            if k > 0:
                moved = bayes.predict(updates[-1].belief, motion, *(given[k - 1] for given in motion_inputs))
                predictions.append(moved)
                predicted.append(moved.belief)
            seen = bayes.update(predicted[-1], measurement, values[k], *(given[k] for given in measurement_inputs))
        except FilterError as error:
            raise FilterError(f"step {k} of {steps}: {error}") from error
        updates.append(seen)
    healthy = [updates[0].healthy] + [p.healthy & u.healthy for p, u in zip(predictions, updates[1:], strict=True)]
    nis = torch.stack([update.nis for update in updates])
    count = [torch.as_tensor(update.count, device=nis.device).expand(nis.shape[1:]) for update in updates]
    return Track(
        _stack(predicted),
        _stack([update.belief for update in updates]),
        torch.stack([update.innovation for update in updates]),
        nis,
        torch.stack(count),
        torch.stack([update.log_likelihood for update in updates]),
        torch.stack(healthy),
        predictions,
    )


def smooth(bayes: BayesFilter, track: Track) -> Gaussian:
    """Beliefs given all measurements, (T, ...), by the RTS recursion (Rauch et al. 1965; Särkkä 2008 for sigma points).

    The backward gain and the covariance of a state given the next come from one triangularisation of their joint
    deviations, so nothing is subtracted: the result is positive semidefinite in any dtype.

    Args:
        bayes: the filter that made the track.
        track: from `filter_sequence`.
    """
    steps = len(track.filtered.mean)
    later = track.filtered[steps - 1]
    smoothed = [later]
    for k in reversed(range(steps - 1)):
        later = _smooth_step(bayes, track.filtered[k], track._predictions[k], later)
        smoothed.append(later)
    return _stack(smoothed[::-1])


def _smooth_step(bayes: BayesFilter, filtered: Gaussian, prediction: TimeUpdate, later: Gaussian) -> Gaussian:
    odd, others, root = prediction.joint_root()
    size = root.shape[-1]
    pieces = [torch.cat([odd, root], dim=-2)]
    pieces += [torch.nn.functional.pad(other, (0, 0, 0, size)) for other in others]
    joint = triangularise(pieces)
    marginal, cross, conditional = joint[..., :size, :size], joint[..., size:, :size], joint[..., size:, size:]
    gain = solve_lower_transposed(marginal, cross.mT).mT
    expected = prediction.belief.mean
    chart = bayes.chart
    difference = later.mean - expected if chart is None else chart(later.mean, expected)
    # The later belief's deviations, seen from the predicted mean instead of its own.
    deviations = bayes.carry(later.mean, None, later.factor, expected)
    shift = apply(gain, difference)
    columns = triangularise([*(multiply(gain, part) for part in deviations), conditional])
    mean = bayes.retract(filtered.mean, shift)
    carried = bayes.carry(filtered.mean, shift, columns, mean)
    if filtered.is_square_root:
        lower = columns if chart is None else triangularise(carried)
        return Gaussian(mean, factor=lower, factor_is_lower=True)
    return Gaussian(mean, square(carried))


def _stack(beliefs: Sequence[Gaussian]) -> Gaussian:
    """Beliefs of one batch shape with time before it, (T, ...)."""
    mean = torch.stack([belief.mean for belief in beliefs])
    # The first belief may be held otherwise than those that a filter returns.
    if beliefs[-1].is_square_root:
        return Gaussian(mean, factor=torch.stack([belief.factor for belief in beliefs]), factor_is_lower=True)
    return Gaussian(mean, torch.stack([belief.covariance for belief in beliefs]))

"""SigmaSLAM's filters on the work of `filter_work`, as a user would drive them."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, TypeAlias

import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_benchmarks.filters.work import (
    LandmarkWork,
    LinearWork,
    LocalisationWork,
    PositionWork,
    StereoWork,
    Work,
    drive,
    project_landmark,
    project_stereo,
    range_and_bearing,
)

Step: TypeAlias = Callable[[], filters.Gaussian]

# The models' arithmetic with vectors in batch-last memory.
_TORCH: Any = SimpleNamespace(
    cos=torch.cos,
    sin=torch.sin,
    hypot=torch.hypot,
    arctan2=torch.arctan2,
    stack=lambda components, _: filters.stack(components),
)


def make(work: Work, dtype: str = "float64", compiled: bool = False, device: str = "cpu") -> Step:
    """A function of no arguments that does one prediction and one update from the prior of the work.

    Args:
        work: any kind.
        dtype: "float64" or "float32".
        compiled: through torch.compile, for the shapes of the work; the first call takes up to a minute.
        device: where to compute.
    """
    numbers = getattr(torch, dtype)

    def tensor(array: Any) -> Tensor:
        return torch.tensor(array, dtype=numbers, device=device)

    # One linearisation, as the peers do; failures are flagged, not raised, where a look at the flag would break a
    # compiled step in two.
    bayes: filters.BayesFilter
    policy: Any = "hold" if compiled else "raise"
    if isinstance(work, LinearWork):
        bayes = filters.KalmanFilter(on_failure=policy)
    else:
        bayes = filters.UnscentedKalmanFilter(iterations=1, on_failure=policy)
    motion, measurement, motion_inputs, measurement_inputs = _models(work, tensor)
    prior = filters.Gaussian(tensor(work.mean), tensor(work.covariance))
    value = tensor(work.measurement)
    if numbers is torch.float32:  # goes on with square roots: start with one
        prior = filters.Gaussian(prior.mean, factor=prior.factor, factor_is_lower=True)
    inputs = [*motion_inputs, value, *measurement_inputs]
    if prior.batch_shape:
        prior = prior.batch_last()
        inputs = [filters.stack(given.unbind(-1)) for given in inputs]

    def step(mean: Tensor, held: Tensor, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        by_root = prior.is_square_root
        belief = filters.Gaussian(mean, factor=held, factor_is_lower=True) if by_root else filters.Gaussian(mean, held)
        controls, seen = inputs[: len(motion_inputs)], inputs[len(motion_inputs) :]
        predicted = bayes.predict(belief, motion, *controls).belief
        result = bayes.update(predicted, measurement, *seen)
        return result.belief.mean, result.belief.held, result.healthy

    run = filters.compile_step(step) if compiled else step

    def one() -> filters.Gaussian:
        with torch.inference_mode():
            mean, held, _ = run(prior.mean, prior.held, *inputs)
        return filters.Gaussian(mean, factor=held) if prior.is_square_root else filters.Gaussian(mean, held)

    return one


def _models(work: Work, tensor: Callable[[Any], Tensor]) -> tuple[Any, Any, list[Tensor], list[Tensor]]:
    """Motion, measurement, and the inputs of both."""
    Q, R = tensor(work.process_noise), filters.Diagonal(tensor(work.measurement_noise.diagonal()))
    if isinstance(work, StereoWork):
        points = tensor(work.points)
        see = filters.MeasurementModel(lambda states: project_stereo(torch, states, points), R)
        return filters.LinearMotion(tensor(work.transition), Q), see, [], []
    if isinstance(work, LinearWork):
        measurement = filters.LinearMeasurement(tensor(work.observation), R)
        return filters.LinearMotion(tensor(work.transition), Q), measurement, [], []
    noise = filters.Diagonal(tensor(work.process_noise.diagonal()))
    if isinstance(work, LandmarkWork):
        stay = filters.LinearMotion(torch.eye(3, dtype=Q.dtype, device=Q.device), noise)
        return stay, filters.MeasurementModel(lambda states: project_landmark(_TORCH, states), R), [], []
    unicycle = filters.MotionModel(lambda states, control: drive(_TORCH, states, control), noise)
    if isinstance(work, PositionWork):
        fix = filters.LinearMeasurement(torch.eye(3, dtype=Q.dtype, device=Q.device)[:2], R)
        return unicycle, fix, [tensor(work.control)], []
    assert isinstance(work, LocalisationWork)
    see = filters.MeasurementModel(
        lambda states, landmark: range_and_bearing(_TORCH, states, landmark), R, residual=_range_and_bearing_difference
    )
    return unicycle, see, [tensor(work.control)], [tensor(work.landmark)]


def _range_and_bearing_difference(measured: Tensor, predicted: Tensor) -> Tensor:
    difference = measured - predicted
    return filters.stack([difference[..., 0], filters.wrap_angle(difference[..., 1])])

"""The extended filter beside the unscented one: the same models, which give no derivatives of their own."""

from collections.abc import Callable

import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core.noise_covariance import as_noise
from sigmaslam_filters.systems import range_and_bearing

BATCHES = (1, 100, 10_000)
_SEED = 0
Step = Callable[[], filters.Gaussian]


def pose_steps(batch: int) -> dict[str, Step]:
    """A pose on SE(3): moved by a twist, then a point of the world is seen in its frame. By the filters' names.

    Args:
        batch: filters, in float64.
    """
    space = filters.SE3()
    motion = filters.MotionModel(space.retract, _diagonal(*[1e-4] * 6))
    see = filters.MeasurementModel(_point_in_frame, _diagonal(*[1e-2] * 3))
    draw = _normal(batch)
    origin = torch.zeros(7, dtype=torch.float64)
    origin[-1] = 1.0
    mean = space.retract(origin.expand(batch, 7), 0.5 * draw(6))
    return _steps(space, mean, 6, motion, see, 0.1 * draw(6), draw(3), 5.0 * draw(3))


def plane_steps(batch: int) -> dict[str, Step]:
    """A robot in R^3 (x, y, heading): driven, then range and bearing of a landmark. By the filters' names."""
    (motion, see), draw = robot_models(), _normal(batch)
    return _steps(None, draw(3), 3, motion, see, 0.1 * draw(2), draw(2), 5.0 * draw(2))


KINDS: dict[str, Callable[[int], dict[str, Step]]] = {"SE(3)": pose_steps, "R^3": plane_steps}


def robot_models() -> tuple[filters.MotionModel, filters.MeasurementModel]:
    """Of a robot in R^3 that is driven by metres and radians, and of range and bearing of a landmark."""
    return filters.MotionModel(_drive, _diagonal(1e-4, 1e-4, 1e-6)), range_and_bearing(_diagonal(1e-2, 1e-4))


def _steps(
    space: filters.Manifold | None,
    mean: Tensor,
    size: int,
    motion: filters.MotionModel,
    measurement: filters.MeasurementModel,
    control: Tensor,
    noise: Tensor,
    landmark: Tensor,
) -> dict[str, Step]:
    batch = mean.shape[0]
    seen = measurement.function(motion.function(mean, control), landmark)
    value = seen + noise * as_noise(measurement.noise).variance().sqrt()
    prior = filters.Gaussian(mean, (0.01 * torch.eye(size, dtype=torch.float64)).expand(batch, size, size))
    inputs = [control, value, landmark]
    if batch == 1:
        prior, inputs = prior[0], [given[0] for given in inputs]
    else:
        prior, inputs = prior.batch_last(), [filters.stack(given.unbind(-1)) for given in inputs]
    control, value, landmark = inputs

    def step(bayes: filters.BayesFilter) -> filters.Gaussian:
        with torch.inference_mode():
            predicted = bayes.predict(prior, motion, control).belief
            return bayes.update(predicted, measurement, value, landmark).belief

    extended = filters.ExtendedKalmanFilter(space, iterations=1)
    unscented = filters.UnscentedKalmanFilter(space, iterations=1)
    return {"EKF": lambda: step(extended), "UKF": lambda: step(unscented)}


def _drive(state: Tensor, control: Tensor) -> Tensor:
    x, y, heading = state[..., 0], state[..., 1], state[..., 2]
    distance, turn = control[..., 0], control[..., 1]
    return filters.stack([x + distance * torch.cos(heading), y + distance * torch.sin(heading), heading + turn])


def _point_in_frame(pose: Tensor, point: Tensor) -> Tensor:
    """World points (..., 3), metres, in the frame of poses (..., 7)."""
    a, b, c = (point[..., k] - pose[..., k] for k in range(3))
    x, y, z, w = (pose[..., k] for k in range(3, 7))
    # v - 2 w (q x v) + 2 q x (q x v), turned back.
    u, v, n = y * c - z * b, z * a - x * c, x * b - y * a
    return filters.stack(
        [
            a + 2.0 * (y * n - z * v - w * u),
            b + 2.0 * (z * u - x * n - w * v),
            c + 2.0 * (x * v - y * u - w * n),
        ]
    )


def _diagonal(*variances: float) -> filters.Diagonal:
    return filters.Diagonal(torch.tensor(variances, dtype=torch.float64))


def _normal(batch: int) -> Callable[[int], Tensor]:
    """Makes standard normal numbers (batch, n), the same for each batch."""
    generator = torch.Generator().manual_seed(_SEED)
    return lambda size: torch.randn(batch, size, generator=generator, dtype=torch.float64)

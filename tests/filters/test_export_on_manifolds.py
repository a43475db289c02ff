"""Graphs of filters on SE(2), SE(3) and products of manifolds do what the filters do."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters import systems
from sigmaslam_filters.models import several
from tests.support.filter_builders import covariances, random_numbers, tensor

PLANE, RIGID = filters.SE2("right"), filters.SE3("right")
RANGE_AND_BEARING = systems.range_and_bearing(torch.eye(2, dtype=torch.float64))
Arguments = tuple[dict[str, Tensor], dict[str, Tensor]]


@dataclass(frozen=True)
class System:
    """A filter's models on a manifold, and how their arguments are drawn.

    Attributes:
        process, variance: of the noise of a step and of a measurement.
        inputs: (batch, number of measurements) -> the motion's inputs and the measurement's, by name.
        is_stack: whether there are several measurements at one time.
    """

    space: filters.Manifold
    move: Callable[..., Tensor]
    process: Tensor
    see: Callable[..., Tensor]
    variance: Tensor
    inputs: Callable[[int, int], Arguments]
    residual: Callable[[Tensor, Tensor], Tensor] | None = None
    is_stack: bool = False

    def models(self, dtype: torch.dtype) -> tuple[filters.MotionModel, filters.MeasurementModel]:
        process, variance = (filters.Diagonal(each.to(dtype)) for each in (self.process, self.variance))
        see = filters.MeasurementModel(self.see, variance, residual=self.residual)
        return filters.MotionModel(self.move, process), see

    def prior(self, batch: int) -> filters.Gaussian:
        """Correlated beliefs about points far from the identity."""
        size = self.space.tangent_size
        origin = torch.zeros(self.space.point_size, dtype=torch.float64)
        if isinstance(self.space, filters.Product) and self.space.parts[0] == RIGID:
            origin[6] = 1.0
        point = self.space.retract(origin.expand(batch, -1), random_numbers(batch, size, seed=1))
        return filters.Gaussian(point, covariances(batch, size, seed=2, scale=0.05))

    def value(self, batch: int, count: int) -> Tensor:
        """What may be measured, without components that are missing."""
        return random_numbers(batch, *([count] if self.is_stack else []), len(self.variance), seed=3)


def robot() -> System:
    """Pose in the plane by odometry, range and bearing of any number of landmarks."""

    def inputs(batch: int, count: int) -> Arguments:
        landmark = 5.0 * random_numbers(batch, count, 2, seed=5)
        return {"odometry": 0.5 * random_numbers(batch, 3, seed=4)}, {"landmark": landmark}

    see, residual = RANGE_AND_BEARING.function, RANGE_AND_BEARING.residual
    process, variance = tensor(1e-3, 1e-3, 1e-4), tensor(1e-2, 4e-4)
    return System(PLANE, PLANE.retract, process, see, variance, inputs, residual, is_stack=True)


def body() -> System:
    """Pose and velocity in its own frame; a position, and the direction of gravity in the body."""

    def move(state: Tensor, seconds: Tensor) -> Tensor:
        pose, twist = state[..., :7], state[..., 7:]
        return torch.cat([RIGID.retract(pose, twist * seconds), twist], dim=-1)

    def see(state: Tensor) -> Tensor:
        down = RIGID.to_matrix(state[..., :7])[..., 2, :3]
        return torch.cat([state[..., :3], down], dim=-1)

    def inputs(batch: int, count: int) -> Arguments:
        return {"seconds": 0.1 + random_numbers(batch, 1, seed=4).abs()}, {}

    process = torch.linspace(1e-4, 1e-2, 12, dtype=torch.float64)
    variance = tensor(0.01, 0.01, 0.04, 2.5e-3, 2.5e-3, 2.5e-3)
    return System(filters.Product(RIGID, filters.Euclidean(6)), move, process, see, variance, inputs)


def mapping() -> System:
    """Pose in the plane and two landmarks, of which range and bearing are seen."""

    def move(state: Tensor, odometry: Tensor) -> Tensor:
        return torch.cat([PLANE.retract(state[..., :3], odometry), state[..., 3:]], dim=-1)

    def see(state: Tensor) -> Tensor:
        return torch.cat([RANGE_AND_BEARING.function(state, state[..., k : k + 2]) for k in (3, 5)], dim=-1)

    def residual(measured: Tensor, predicted: Tensor) -> Tensor:
        assert RANGE_AND_BEARING.residual is not None
        return RANGE_AND_BEARING.residual(measured.unflatten(-1, (2, 2)), predicted.unflatten(-1, (2, 2))).flatten(-2)

    def inputs(batch: int, count: int) -> Arguments:
        return {"odometry": 0.5 * random_numbers(batch, 3, seed=4)}, {}

    process, variance = tensor(1e-3, 1e-3, 1e-4, 1e-6, 1e-6, 1e-6, 1e-6), tensor(1e-2, 4e-4, 1e-2, 4e-4)
    space = filters.Product(PLANE, filters.Euclidean(4))
    return System(space, move, process, see, variance, inputs, residual)


UKF, EKF, DOUBLE, SINGLE = filters.UnscentedKalmanFilter, filters.ExtendedKalmanFilter, torch.float64, torch.float32


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "make", "dtype"),
    [
        pytest.param(robot, UKF, DOUBLE, id="robot, ukf, float64"),
        pytest.param(robot, UKF, SINGLE, id="robot, ukf, float32"),
        pytest.param(robot, EKF, DOUBLE, id="robot, ekf, float64"),
        pytest.param(body, UKF, DOUBLE, id="body, ukf, float64"),
        pytest.param(body, EKF, SINGLE, id="body, ekf, float32"),
        pytest.param(mapping, UKF, DOUBLE, id="mapping, ukf, float64"),
        pytest.param(mapping, EKF, DOUBLE, id="mapping, ekf, float64"),
    ],
)
def test_graph_on_a_manifold_equals_torch_for_other_batches_and_missing_components(system, make, dtype, tmp_path):
    tolerance = 1e-12 if dtype == DOUBLE else 1e-4
    given = system()
    bayes = make(given.space, iterations=1, on_failure="hold")
    motion_inputs, measurement_inputs = _of(given.inputs(2, 3), dtype)
    value = given.value(2, 3).to(dtype)
    example = filters.StepExample(given.prior(2).to(dtype), value, motion_inputs, measurement_inputs)
    path = tmp_path / "step.onnx"
    assert filters.export_step(bayes, *given.models(dtype), example, path) < tolerance
    session = onnxruntime.InferenceSession(path)
    for batch, count in ((1, 1), (5, 4)):
        found, expected = _both(session, given, bayes, batch, count, dtype)
        for name, each in expected.items():
            scale = max(1.0, float(np.abs(each).max()))
            np.testing.assert_allclose(found[name], each, rtol=0, atol=tolerance * scale, err_msg=name)
        assert found["healthy"].all()
        assert found["count"][0] < given.value(1, count)[0].numel()


def _of(inputs: Arguments, dtype: torch.dtype) -> Arguments:
    motion, measurement = ({name: each.to(dtype) for name, each in named.items()} for named in inputs)
    return motion, measurement


def _both(
    session: onnxruntime.InferenceSession,
    given: System,
    bayes: filters.BayesFilter,
    batch: int,
    count: int,
    dtype: torch.dtype,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Outputs of the graph and of the filter, of the first element a component missing, of the last all."""
    prior, value = given.prior(batch).to(dtype), given.value(batch, count).to(dtype)
    if batch > 1:
        value[-1] = torch.nan
    value[0, ..., 0] = torch.nan
    by_root = dtype == torch.float32
    motion_inputs, measurement_inputs = _of(given.inputs(batch, count), dtype)
    held = {"root": prior.factor} if by_root else {"covariance": prior.covariance}
    feed = {"mean": prior.mean, **held, **motion_inputs, "value": value, **measurement_inputs}
    outputs = session.run(None, {name: each.contiguous().numpy() for name, each in feed.items()})
    found = dict(zip([each.name for each in session.get_outputs()], outputs, strict=True))

    motion, measurement = given.models(dtype)
    if given.is_stack:
        measurement, value = several(measurement, count), value.flatten(-2)
    if by_root:
        prior = filters.Gaussian(prior.mean, factor=prior.factor, factor_is_lower=True)
    moved = bayes.predict(prior, motion, *motion_inputs.values())
    seen = bayes.update(moved.belief, measurement, value, *measurement_inputs.values())
    expected = {
        "posterior_mean": seen.belief.mean,
        "posterior_root" if by_root else "posterior_covariance": seen.belief.held,
        "log_likelihood": seen.log_likelihood,
        "nis": seen.nis,
        "count": torch.as_tensor(seen.count),
    }
    return found, {name: each.numpy() for name, each in expected.items()}

"""A filter's step as an ONNX graph does what the filter does, for batches and numbers that were not traced."""

import importlib.util
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters import systems
from sigmaslam_filters.core import factors, plain_factors
from sigmaslam_filters.core.transforms import push_forward
from sigmaslam_filters.graphs.exact_operators import ExactOperators
from sigmaslam_filters.graphs.step_export import _Step
from sigmaslam_filters.models import several
from tests.support.filter_assertions import assert_close, assert_same_update
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "filters" / "export_my_filter.py"


@pytest.mark.parametrize("size", [1, 5, 24])
def test_plain_operators_equal_lapack(size):
    P, right = covariances(3, size), random_numbers(3, size, 4, seed=2)
    factor, healthy = plain_factors.cholesky(P)
    assert bool(healthy.all())
    assert_close(factor, torch.linalg.cholesky(P), 1e-12)
    wide = random_numbers(3, size, 2 * size + 1, seed=3)
    assert_close(plain_factors.triangularise(wide), factors.triangularise([wide]), 1e-11)
    narrow = random_numbers(3, size, max(size - 2, 1), seed=3)
    lower = plain_factors.triangularise(narrow)
    assert_close(lower @ lower.mT, narrow @ narrow.mT, 1e-11)
    assert_close(
        plain_factors.solve_lower(factor, right, True), torch.linalg.solve_triangular(factor, right, upper=False), 1e-10
    )
    assert_close(
        plain_factors.solve_lower_transposed(factor, right),
        torch.linalg.solve_triangular(factor.mT, right, upper=True),
        1e-10,
    )


@pytest.mark.parametrize("form", ["dense", "low-rank", "qr"])
def test_a_step_in_plain_operators_equals_the_step(form):
    """Without a graph: the functions alone are replaced."""
    prior, z = beliefs(3, 4), random_numbers(3, 6)
    z[1, 2] = torch.nan
    bayes = filters.UnscentedKalmanFilter(form=form, on_failure="hold")
    models = bent_motion(4), bent_measurement(4, 6)

    def step() -> filters.Update:
        return bayes.update(bayes.predict(prior, models[0]).belief, models[1], z)

    expected = step()
    with plain_factors.traced_for_export(), ExactOperators():
        found = step()
        assert_same_update(found, expected, 1e-10)
    assert not plain_factors.is_exporting()


def test_replaced_functions_keep_their_digits():
    x, y = random_numbers(200), random_numbers(200, seed=1)
    pairs = (
        lambda: torch.atan2(y, x),
        lambda: torch.atan2(y, torch.zeros_like(x)),
        lambda: torch.atan2(torch.zeros_like(y), x),
        lambda: x.atan(),
        lambda: torch.asin(torch.sin(x)),
        lambda: torch.acos(torch.cos(x)),
        lambda: torch.hypot(x, y),
        lambda: torch.copysign(x, y),
        lambda: torch.addcmul(x, x, y, value=0.1),
        lambda: torch.sub(x, y, alpha=0.1),
        lambda: torch.full_like(x, 0.1),
        lambda: torch.where(x > 0.1, x, 0.7),
        lambda: 1.1 / x.clamp_min(1e-310),
        lambda: 3.3 - x * 1e300,
    )
    for function in pairs:
        expected = function()
        with ExactOperators():
            found = function()
        torch.testing.assert_close(found, expected, rtol=1e-13, atol=2e-15)


@pytest.mark.parametrize("kind", ["diagonal", "dense", "linear"])
def test_several_measurements_are_those_of_one_model_side_by_side(kind):
    """As one update after the other, of a linear function; and with a residual, as the stacked model by hand."""
    prior, H = beliefs(3), random_numbers(2, 3, seed=1)
    R = covariances(2, seed=2) if kind != "diagonal" else torch.diag(tensor(0.3, 0.2))
    noise = filters.Diagonal(R.diagonal()) if kind == "diagonal" else R
    one = (
        filters.LinearMeasurement(H, noise)
        if kind == "linear"
        else filters.MeasurementModel(lambda x: x @ H.mT, noise, residual=lambda a, b: a - b)
    )
    z = random_numbers(4, 2, seed=3)
    z[2, 1] = torch.nan
    ukf = filters.UnscentedKalmanFilter()
    together = ukf.update(prior, several(one, 4), z.flatten())
    belief, total = prior, 0.0
    for value in z:
        after = ukf.update(belief, one, value)
        belief, total = after.belief, total + after.log_likelihood
    assert_close(together.belief.mean, belief.mean, 1e-11)
    assert_close(together.belief.covariance, belief.covariance, 1e-11)
    assert_close(together.log_likelihood, total, 1e-10)


def robot(dtype: torch.dtype) -> tuple[filters.MotionModel, filters.MeasurementModel, filters.StepExample]:
    """Drives with noisy controls and sees ranges and bearings of landmarks."""
    motion = systems.differential_drive(filters.Diagonal(tensor(0.05, 0.02).to(dtype) ** 2))
    see = systems.range_and_bearing(filters.Diagonal(tensor(0.1, 0.02).to(dtype) ** 2))
    belief = filters.Gaussian(tensor(0.0, 0.0, 3.1).to(dtype), torch.diag(tensor(0.1, 0.1, 0.02)).to(dtype))
    example = filters.StepExample(
        belief,
        random_numbers(2, 2).to(dtype),
        {"control": tensor(1.0, 0.1).to(dtype), "time_step": tensor(0.1).to(dtype)},
        {"landmark": (5.0 * random_numbers(2, 2, seed=1)).to(dtype)},
    )
    return motion, see, example


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_graph_of_a_robot_equals_torch_for_any_batch_and_number_of_landmarks(dtype, tmp_path):
    motion, see, example = robot(dtype)
    bayes = filters.UnscentedKalmanFilter(iterations=1)
    path = tmp_path / "robot.onnx"
    tolerance = 1e-9 if dtype == torch.float64 else 1e-4
    assert filters.export_step(bayes, motion, see, example, path) <= tolerance
    session = onnxruntime.InferenceSession(path)
    held = "covariance" if dtype == torch.float64 else "root"
    for batch, count in ((1, 1), (2, 11), (6, 3)):
        prior = beliefs(batch, 3, scale=0.1).to(dtype)
        control, landmark = random_numbers(batch, 2).to(dtype), 5.0 * random_numbers(batch, count, 2, seed=4).to(dtype)
        value = random_numbers(batch, count, 2, seed=5).to(dtype)
        value[0, 0, 0] = torch.nan
        feed = {"mean": prior.mean, held: getattr(prior, {"root": "factor"}.get(held, held))}
        time_step = 0.1 + random_numbers(batch, 1, seed=6).abs().to(dtype)
        feed |= {"control": control, "time_step": time_step, "value": value, "landmark": landmark}
        found = session.run(None, {name: given.contiguous().numpy() for name, given in feed.items()})
        moved = bayes.predict(prior, motion, control, time_step)
        belief = moved.belief
        stacked = bayes.update(belief, several(see, count), value.flatten(-2), landmark)
        expected = (stacked.belief.mean, stacked.belief.held, stacked.healthy, stacked.log_likelihood, stacked.nis)
        for a, b in zip(found, expected, strict=False):
            np.testing.assert_allclose(a, b.numpy(), rtol=100 * tolerance, atol=10 * tolerance)
        assert found[-1].tolist() == torch.as_tensor(stacked.count).expand(batch).tolist()


def test_a_belief_of_as_many_states_as_there_are_landmarks_is_not_one_of_them():
    motion, see, example = robot(torch.float64)
    values, landmarks = random_numbers(1, 3, 2), random_numbers(1, 3, 2, seed=1)
    example = filters.StepExample(
        example.belief.expand((1,)), values, {"control": tensor(1.0, 0.1)[None]}, {"landmark": landmarks}
    )
    step = _Step(filters.UnscentedKalmanFilter(), motion, see, example, None, None)
    assert [tuple(each.shape) for each in step.resized(2, 5)] == [(2, 3), (2, 3, 3), (2, 2), (2, 5, 2), (2, 5, 2)]


@pytest.mark.slow
def test_graph_of_an_extended_filter_needs_no_derivatives_of_the_models(tmp_path):
    motion, see, example = robot(torch.float64)
    example = filters.StepExample(
        example.belief, tensor(3.0, 0.4), example.motion_inputs, {"landmark": tensor(3.0, 1.0)}
    )
    ekf = filters.ExtendedKalmanFilter(form="dense")
    assert filters.export_step(ekf, motion, see, example, tmp_path / "ekf.onnx") < 1e-12


def test_derivatives_through_the_backward_pass_are_the_forward_ones():
    x, along = random_numbers(5, 3), random_numbers(5, 3, seed=1)

    def function(offsets):
        return torch.atan2(offsets, 1.0 + offsets * offsets)

    expected = push_forward(function, [x], [along])
    with plain_factors.traced_for_export():
        found = push_forward(function, [x], [along])
    for a, b in zip(found, expected, strict=True):
        assert_close(a, b, 1e-15)


@pytest.mark.slow
def test_the_example_exports_a_filter_on_its_own_manifold(tmp_path):
    specification = importlib.util.spec_from_file_location("export_my_filter", EXAMPLE)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    assert module.export(tmp_path / "dial.onnx") < 1e-12
    assert abs(module.run(tmp_path / "dial.onnx")) < 0.2


@pytest.mark.slow
def test_a_graph_that_differs_from_torch_is_not_written(tmp_path, monkeypatch):
    """A model whose function is not the same when it is called again."""
    calls = []

    def drifting(x: Tensor) -> Tensor:
        calls.append(0)
        return x + 1e-6 * len(calls)

    motion = filters.MotionModel(drifting, filters.Diagonal(tensor(0.1, 0.1)))
    with pytest.raises(filters.ExportError, match=r"drift\.onnx differs from torch by .*e-0[5-7].*not written"):
        filters.export_step(
            filters.UnscentedKalmanFilter(), motion, None, filters.StepExample(beliefs(2)), tmp_path / "drift.onnx"
        )
    assert not list(tmp_path.iterdir())


def test_a_step_needs_models_and_a_value_that_fit(tmp_path):
    export = filters.export_step
    ukf, example = filters.UnscentedKalmanFilter(), filters.StepExample(beliefs(2))
    with pytest.raises(ValueError, match="a motion, a measurement, or both"):
        export(ukf, None, None, example, tmp_path / "a.onnx")
    with pytest.raises(ValueError, match="needs a value in the example"):
        export(ukf, None, bent_measurement(2, 2), example, tmp_path / "a.onnx")
    with pytest.raises(ValueError, match="one dimension at most"):
        export(ukf, bent_motion(2), None, filters.StepExample(beliefs(3, 2, 2)), tmp_path / "a.onnx")

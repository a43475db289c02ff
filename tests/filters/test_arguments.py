"""What does not fit is refused by a message that names the model, the argument and the mend; what may fit does."""

import numpy as np
import pytest
import torch

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

UKF = filters.UnscentedKalmanFilter()
UNIT = torch.eye(3, dtype=torch.float64)
ONE = filters.Diagonal(tensor(0.1))


def see(noise=None):
    return filters.MeasurementModel(
        lambda x: x[..., :2], filters.Diagonal(tensor(1.0, 1.0)) if noise is None else noise
    )


def sight(noise=None):
    return filters.LinearMeasurement(UNIT[:2], torch.eye(2, dtype=torch.float64) if noise is None else noise)


REFUSED = {
    "motion noise of one": (
        lambda: UKF.predict(beliefs(3), filters.MotionModel(torch.sin, ONE)),
        "MotionModel.noise.*1 x 1.*3 x 3",
    ),
    "motion noise of four": (
        lambda: UKF.predict(beliefs(3), filters.MotionModel(torch.sin, covariances(4))),
        "MotionModel.noise.*4 x 4.*3 x 3",
    ),
    "linear motion noise": (
        lambda: UKF.predict(beliefs(3), filters.LinearMotion(UNIT, ONE)),
        "LinearMotion.noise.*1 x 1.*3 x 3",
    ),
    "linear motion matrix": (
        lambda: UKF.predict(beliefs(3), filters.LinearMotion(UNIT[:2], ONE)),
        r"LinearMotion.matrix.*\(2, 3\).*3 x 3",
    ),
    "noise matrix": (
        lambda: UKF.predict(beliefs(3), filters.LinearMotion(UNIT, covariances(2), noise_matrix=UNIT)),
        r"LinearMotion.noise.*2 x 2.*3 x 3.*noise_matrix",
    ),
    "motion output": (
        lambda: UKF.predict(beliefs(3), filters.MotionModel(lambda x: x[..., :2], covariances(3))),
        r"MotionModel.noise is 3 x 3.*function returns 2 components",
    ),
    "measurement noise": (
        lambda: UKF.update(beliefs(3), see(ONE), tensor(0.0, 0.0)),
        "MeasurementModel.noise.*1 x 1.*2 x 2",
    ),
    "linear noise": (
        lambda: UKF.update(beliefs(3), sight(ONE), tensor(0.0, 0.0)),
        "LinearMeasurement.noise.*1 x 1.*2 x 2",
    ),
    "linear matrix": (
        lambda: UKF.update(beliefs(4), sight(), tensor(0.0, 0.0)),
        r"LinearMeasurement.matrix.*\(2, 3\).*4 columns",
    ),
    "value of one": (
        lambda: UKF.update(beliefs(3), sight(), tensor(0.0)),
        "this LinearMeasurement has 2 components, the value has 1",
    ),
    "function's value of one": (
        lambda: UKF.update(beliefs(3), see(), tensor(0.0)),
        "value has 1 components, but MeasurementModel.function returns 2",
    ),
    "mask": (
        lambda: UKF.update(
            beliefs(3),
            filters.MeasurementModel(lambda x: x[..., :2], torch.eye(2).double(), mask=torch.ones(3) > 0),
            tensor(0.0, 0.0),
        ),
        r"MeasurementModel.mask.*\(3,\).*2 components",
    ),
    "mean and covariance": (
        lambda: UKF.predict(filters.Gaussian(torch.zeros(4).double(), UNIT), bent_motion(3)),
        "mean.*4.*covariance.*3 x 3.*space",
    ),
    "batch of noise": (
        lambda: UKF.update(beliefs(5, 3), see(torch.ones(4, 1, 1) * UNIT[:2, :2]), random_numbers(5, 2)),
        r"batch of MeasurementModel.noise \(4,\).*\(5,\)",
    ),
    "batch of the value": (
        lambda: UKF.update(beliefs(5, 3), see(), random_numbers(4, 2)),
        r"batch of the value \(4,\).*\(5,\)",
    ),
    "type of noise": (
        lambda: UKF.update(beliefs(3), see(torch.eye(2)), tensor(0.0, 0.0)),
        r"MeasurementModel.noise.*float32.*float64.*\.to\(",
    ),
    "type of value": (lambda: UKF.update(beliefs(3), see(), torch.zeros(2)), r"value.*float32.*float64.*\.to\("),
    "half": (lambda: filters.Gaussian(torch.zeros(2).half(), torch.eye(2).half()), "float16.*float32"),
}
WRONG_TYPES = {
    "noise": (
        lambda: UKF.update(beliefs(3), see(np.eye(2)), tensor(0.0, 0.0)),
        "MeasurementModel.noise.*numpy.ndarray.*torch.as_tensor",
    ),
    "motion noise": (
        lambda: UKF.predict(beliefs(3), filters.MotionModel(torch.sin, 0.1)),
        "MotionModel.noise.*float.*torch.as_tensor",
    ),
    "value": (lambda: UKF.update(beliefs(3), see(), np.zeros(2)), "value.*numpy.ndarray.*torch.as_tensor"),
    "list": (lambda: UKF.update(beliefs(3), see(), [0.0, 0.0]), "value.*list.*torch.as_tensor"),
    "input": (
        lambda: UKF.update(beliefs(3), see(), tensor(0.0, 0.0), np.zeros(2)),
        "input 0.*numpy.ndarray.*torch.as_tensor",
    ),
    "diagonal": (lambda: filters.Diagonal(np.ones(2)), "Diagonal.*numpy.ndarray.*torch.as_tensor"),
    "blocks": (lambda: filters.BlockDiagonal(np.ones((2, 2, 2))), "BlockDiagonal.*numpy.ndarray.*torch.as_tensor"),
    "mean": (lambda: filters.Gaussian(np.zeros(2), torch.eye(2)), "mean.*numpy.ndarray.*torch.as_tensor"),
    "covariance": (lambda: filters.Gaussian(torch.zeros(2), np.eye(2)), "covariance.*numpy.ndarray.*torch.as_tensor"),
    "values": (
        lambda: UKF.filter(beliefs(3), bent_motion(3), see(), np.zeros((4, 2))),
        "values.*numpy.ndarray.*torch.as_tensor",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_shapes_and_dtypes_that_do_not_fit_are_named(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("name", WRONG_TYPES)
def test_what_is_no_tensor_is_named(name):
    call, message = WRONG_TYPES[name]
    with pytest.raises(TypeError, match=message):
        call()


def test_a_prior_without_batch_is_filtered_with_a_batch_of_values():
    """As the same prior in every element, smoother included."""
    values = random_numbers(5, 4, 2)
    models = bent_motion(3), bent_measurement(3, 2)
    track = UKF.filter(beliefs(3), *models, values)
    expected = UKF.filter(beliefs(3).expand((4,)), *models, values)
    assert_same_belief(track.filtered, expected.filtered, 0.0)
    assert_same_belief(track.predicted, expected.predicted, 0.0)
    assert_same_belief(UKF.smooth(track), UKF.smooth(expected), 1e-15)


class Circle:
    """Angles; two functions and two sizes, as the guide asks for."""

    point_size = tangent_size = 1

    def retract(self, point, tangent):
        return filters.wrap_angle(point + tangent)

    def local(self, point, other):
        return filters.wrap_angle(other - point)


def test_a_manifold_is_two_functions_and_two_sizes():
    heading = filters.MeasurementModel(lambda x: x, tensor(0.04)[None], residual=lambda a, b: filters.wrap_angle(a - b))
    prior = filters.Gaussian(tensor(3.1), tensor(0.1)[None])
    turn = filters.MotionModel(lambda x: filters.wrap_angle(x + 0.1), tensor(0.01)[None])
    found, expected = (
        bayes.update(bayes.predict(prior, turn).belief, heading, tensor(3.0)).belief
        for bayes in map(filters.UnscentedKalmanFilter, (Circle(), filters.SO2()))
    )
    assert_same_belief(found, expected, 1e-15)
    readings = [filters.Observation(heading, tensor(3.0)), filters.Observation(heading, tensor(-3.1))]
    estimates = [filters.maximum_likelihood(readings, tensor(3.0), space) for space in (Circle(), filters.SO2())]
    assert_same_belief(estimates[0].belief, estimates[1].belief, 1e-15)

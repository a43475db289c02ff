import numpy as np
import pytest
from scipy import stats

from sigmaslam.estimation.mahalanobis import quantiles, squared_mahalanobis


@pytest.mark.parametrize("size", [1, 2, 3])
def test_squared_mahalanobis_equals_the_inverse_written_out(size: int):
    rng = np.random.default_rng(4)
    root, error = rng.standard_normal((50, size, size)), rng.standard_normal((50, size))
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(size)
    expected = [e @ np.linalg.inv(C) @ e for e, C in zip(error, covariance, strict=True)]
    np.testing.assert_allclose(squared_mahalanobis(error, covariance), expected)


def test_squared_mahalanobis_of_draws_is_chi_square():
    covariance = np.array([[2.0, 0.7], [0.7, 0.5]])
    error = np.random.default_rng(5).multivariate_normal(np.zeros(2), covariance, 5000)
    square = squared_mahalanobis(error, np.tile(covariance, (5000, 1, 1)))
    assert stats.kstest(square, stats.chi2(2).cdf).pvalue > 0.01


def test_any_leading_dimensions_are_the_same_as_one():
    rng = np.random.default_rng(6)
    root, residual = rng.standard_normal((4, 5, 3, 3)), rng.standard_normal((4, 5, 3))
    covariance = root @ root.swapaxes(2, 3) + np.eye(3)
    flat = squared_mahalanobis(residual.reshape(20, 3), covariance.reshape(20, 3, 3))
    np.testing.assert_array_equal(squared_mahalanobis(residual, covariance).ravel(), flat)


@pytest.mark.parametrize("count", [1, 2, 7, 290])
def test_quantiles_are_those_of_numpy_to_the_bit(count: int):
    shares = np.array([0.0, 0.3, 0.5, 0.65, 0.8, 1.0])
    for values in np.random.default_rng(7).exponential(size=(50, count)):
        for some in (values, np.round(values, 1)):
            assert quantiles(some, shares).tobytes() == np.quantile(some, shares).tobytes()

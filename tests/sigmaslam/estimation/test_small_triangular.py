import numpy as np
import pytest

from sigmaslam.estimation.small_triangular import solve_lower


@pytest.mark.parametrize(("size", "count"), [(3, 50), (6, 7), (1, 3), (3, 0)])
def test_substitution_solves_the_systems(size: int, count: int):
    rng = np.random.default_rng(size)
    lower = np.tril(rng.normal(size=(count, size, size))) + 3.0 * np.eye(size)
    expected = rng.normal(size=(count, size, 5))
    np.testing.assert_allclose(solve_lower(lower, lower @ expected), expected, rtol=1e-9, atol=1e-12)

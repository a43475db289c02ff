import numpy as np
import pytest
from scipy.stats import chi2, norm

from sigmaslam.estimation.chi_square import (
    CHI_SQUARE_68_OF_2,
    CHI_SQUARE_95,
    CHI_SQUARE_99_OF_2,
    CHI_SQUARE_999,
    CHI_SQUARE_9999_OF_6,
    CHI_SQUARE_BAND_OF_6,
    CHI_SQUARE_MEDIAN,
    NORMAL_WITHIN_2,
)


def test_the_constants_are_the_quantiles():
    np.testing.assert_allclose(CHI_SQUARE_999[1:], chi2.isf(1e-3, np.arange(1, 7)), rtol=1e-12)
    np.testing.assert_allclose([CHI_SQUARE_99_OF_2, CHI_SQUARE_9999_OF_6], chi2.isf([1e-2, 1e-4], [2, 6]), rtol=1e-12)
    np.testing.assert_allclose(CHI_SQUARE_68_OF_2, chi2.ppf(0.68, 2), rtol=1e-12)
    np.testing.assert_allclose(CHI_SQUARE_95[1:], chi2.ppf(0.95, np.arange(1, 7)), rtol=1e-12)
    np.testing.assert_allclose(CHI_SQUARE_BAND_OF_6, chi2.ppf([0.025, 0.975], 6), rtol=1e-12)
    np.testing.assert_allclose(CHI_SQUARE_MEDIAN[1:], chi2.median([1, 2, 3]), rtol=1e-12)
    assert pytest.approx(1.0 - 2.0 * norm.sf(2.0), rel=1e-12) == NORMAL_WITHIN_2

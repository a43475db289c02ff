"""What the chapter claims of its filters, on few samples."""

import numpy as np
import pytest

from sigmaslam_benchmarks.filters.claims import compare_bananas, compare_filters


@pytest.mark.long
def test_the_unscented_filter_follows_the_banana_and_the_extended_one_does_not():
    rows = {(row.name, row.spread): row for row in compare_bananas(samples=500)}
    widest = max(spread for _, spread in rows)
    extended, unscented = (rows[f"{name}, R^3", widest] for name in ("EKF", "UKF"))
    # The extended filter goes on straight ahead: its x is too far by more than chance.
    assert extended.bias.low > 0.0
    assert abs(unscented.bias.mean) < 0.5 * extended.bias.mean
    assert unscented.divergence.mean < extended.divergence.mean
    # In the chart of SE(2) the banana is more of a Gaussian: more of the samples are in its 95 % region.
    assert rows["UKF, R^3", widest].coverage.mean < rows["UKF, SE(2)", widest].coverage.mean < 0.96


@pytest.mark.slow
def test_comparisons_say_how_sure_they_are():
    for row in compare_filters(runs=20):
        assert row.change.low <= row.change.mean <= row.change.high
        assert np.all(np.isfinite([*row.rmse, *row.nees, row.better]))
        if row.change.high < 0.0:
            assert row.rmse[1] < row.rmse[0]

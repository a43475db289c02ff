"""What matches that disagree with a pose can explain at most."""

from itertools import combinations

import numpy as np
import pytest

from sigmaslam.geometry.image_cells import explained_area
from sigmaslam.slam.second_motion import _among, _most_departing
from sigmaslam.two_view.scene_pose import see_the_same


@pytest.mark.parametrize("seed", range(6))
def test_no_matches_that_depart_explain_more_than_the_bound(seed: int) -> None:
    """Nor are they more; the bound is reached."""
    rng = np.random.default_rng(seed)
    cells, equal = rng.integers(0, 5, 24), np.ones(24)
    others, departs = np.sort(rng.choice(24, 9, replace=False)), rng.choice([1.0, 4.0], 9, p=[0.7, 0.3])
    bound = _most_departing(cells, others, departs)
    most, reached = explained_area(cells, bound, equal), 0.0
    for count in range(1, 10):
        for subset in map(list, combinations(range(9), count)):
            if not see_the_same(departs[subset]):
                assert count <= bound.sum()
                reached = max(reached, explained_area(cells, _among(others[subset], 24), equal))
    assert reached == pytest.approx(most)


def test_matches_that_stay_where_they_are_bound_nothing_else_in() -> None:
    assert not _most_departing(np.zeros(12, np.int64), np.arange(9), np.full(9, 1.0)).any()

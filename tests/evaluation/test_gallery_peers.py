"""The gallery's problems by filterpy: the same answer where it has one."""

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("filterpy")
from sigmaslam_benchmarks.filters import gallery_peers

pytestmark = pytest.mark.long


@pytest.mark.parametrize("title", [title for title in gallery_peers.PROBLEMS if title != "fixed lag"])
def test_filterpy_s_answer_is_ours(title):
    make, ours, peer = gallery_peers.PROBLEMS[title]
    data = make(1)
    np.testing.assert_allclose(ours(data), peer(data), atol=1e-9)


def test_filterpy_s_fixed_lag_is_no_better():
    """Ours is better; `tests/filters` holds it against what is known later."""
    make, ours, peer = gallery_peers.PROBLEMS["fixed lag"]
    data = make(1)
    errors = [np.sqrt(np.mean((solve(data) - data["truth"]) ** 2)) for solve in (ours, peer)]
    assert errors[0] < 0.9 * errors[1]

"""Features at a distance from each other and from what is occupied."""

import numpy as np
import pytest

from sigmaslam.frontend import patch_kernels
from sigmaslam.frontend.feature_spacing import select_spaced
from sigmaslam.frontend.types import Features


@pytest.mark.parametrize(("count", "taken", "spacing"), [(600, 80, 12.0), (600, 0, 1.0), (0, 5, 12.0), (40, 3, 19.4)])
def test_compiled_selection_equals_its_twin_to_the_bit(count, taken, spacing, monkeypatch):
    pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    rng = np.random.default_rng(count + taken)
    places = rng.uniform(-0.7, (320, 96), (count, 2)).astype(np.float32)
    scores = rng.integers(0, 50, count).astype(np.float32)
    features = Features(places, np.zeros((count, 1), np.float32), scores, np.ones(count, np.float32))
    arguments = features, rng.uniform(-20.0, 340.0, (taken, 2)), spacing, (96, 320)
    found = select_spaced(*arguments)
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    expected = select_spaced(*arguments)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)
    chosen = places[found].astype(np.float64)
    apart = np.linalg.norm(chosen[:, None] - chosen, axis=2) + 1e3 * np.eye(len(chosen))
    assert apart.min(initial=np.inf) > spacing - 2.0

"""Depths of a keyframe against exact ones."""

from types import SimpleNamespace

import numpy as np
import pytest

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_benchmarks.tracking.depth_accuracy import judge_pixels, summarise


def test_errors_and_sigmas_in_millimetres_are_those_of_the_depth():
    camera = RectifiedStereo(500.0, 500.0, 2.0, 0.5, 0.1, 4, 1)
    truth = np.array([[0.05, 0.1, 0.1, np.inf]])
    fused = np.array([[1e3, 50 / 0.101, 50 / 0.098, 1.0]])
    # A sigma of one percent of the disparity is one of one percent of the depth.
    depth = SimpleNamespace(
        fused=SimpleNamespace(disparity=fused, variance=(0.004 * fused) ** 2),
        variance=(0.01 * fused) ** 2,
        is_point=np.ones((1, 4), bool),
    )
    seen = np.ones((1, 4), bool)
    found = summarise(judge_pixels(depth, fused, truth, seen, ~seen, camera), 1)
    assert found.error_mm == pytest.approx(1.0)
    assert found.sigma_mm == pytest.approx(1.0, abs=0.02)
    assert found.error95_mm == pytest.approx(1.9)
    assert found.inside == pytest.approx(2 / 3)
    assert found.within == pytest.approx((1 / 3, 1.0))
    assert found.within_alone == pytest.approx((1 / 3, 1 / 3))
    assert found.completeness == 1.0

"""Whether probability holds: curves counted by hand, and places of steps whose truth is known."""

import numpy as np
import pytest

from sigmaslam.frontend.descriptor import RefinedMatches
from sigmaslam.frontend.image_pair import Matches
from sigmaslam.frontend.types import Features
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_benchmarks.matching import forward_motion
from sigmaslam_benchmarks.matching.forward_motion import MeasuredMatches, judge_probability, measure_steps
from sigmaslam_benchmarks.matching.stereo import StereoStep


def test_claimed_and_right_shares_are_counted_by_bins():
    probability = np.array([0.1, 0.1, 0.6, 0.6, 0.9, 1.0])
    error = np.array([9.0, 1.0, 1.0, 9.0, 2.9, 0.0])
    deviation = np.array([[0.5, 9.0], [0.5, 1.5], [0.5, 0.5], [9.0, 9.0], [3.0, 0.5], [0.1, 0.1]])
    judged = judge_probability(MeasuredMatches(probability, error, deviation))
    assert judged.claimed == pytest.approx((0.1, np.nan, 0.6, 0.9, 1.0), nan_ok=True)
    assert judged.right == pytest.approx((0.5, np.nan, 0.5, 1.0, 1.0), nan_ok=True)
    assert judged.precision == pytest.approx(3 / 4)
    assert judged.lost == pytest.approx(1 / 4)
    assert judged.within_1 == pytest.approx(6 / 8)
    assert judged.within_2 == pytest.approx(7 / 8)


def test_matches_of_a_step_are_measured_from_where_stereo_and_the_motion_have_them(monkeypatch: pytest.MonkeyPatch):
    """The second slides along its epipolar line, by which it would be right; the third has no stereo match."""
    camera = RectifiedStereo(400.0, 400.0, 320.0, 240.0, 0.5, 640, 480)
    points = np.array([[1.0, 0.5, 8.0], [-1.0, 0.2, 5.0], [0.3, -0.4, 6.0]])
    T_1_0 = np.eye(4)
    T_1_0[2, 3] = -1.0
    first, second = camera.project(points), camera.project(points + T_1_0[:3, 3])
    epipole = np.array([320.0, 240.0])
    along = (second[1, :2] - epipole) / np.linalg.norm(second[1, :2] - epipole)
    second[1, :2] += 7.0 * along
    index, ones = np.arange(3), np.ones(3, np.float32)
    features = Features(first[:, :2].astype(np.float32), np.zeros((3, 0), np.float32), ones, ones)
    covariance = np.tile(np.eye(2), (3, 1, 1))
    eyes = RefinedMatches(
        index, index, first[:, :2] - first[:, 2:] * [1.0, 0.0], np.array([0.95, 0.99, 0.6]), covariance
    )
    matches = Matches(features.keypoints, second[:, :2].astype(np.float32), 0.8 * ones, covariance, index, index)
    monkeypatch.setattr(forward_motion, "match_eyes", lambda *_: eyes)
    monkeypatch.setattr(forward_motion, "match_features", lambda *_: matches)
    image = np.zeros((480, 640), np.uint8)
    measured = measure_steps([StereoStep("0 1", image, image, image, camera, T_1_0)], lambda image: features, None)
    np.testing.assert_allclose(measured.error, [0.0, 7.0], atol=1e-3)
    assert measured.deviation is None

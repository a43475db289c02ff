"""Noise of what is measured: a match's own, and what no match knows."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.frontend import TemporalMatches
from sigmaslam.frontend.types import Features, StereoView
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.measurement_noise import UNMODELLED, MeasurementNoise

SIGMAS = np.array([1e-4, 0.05, 0.3, 2.0])
PLACES = np.array([[10.0, 20.0], [300.0, 40.0], [30.0, 200.0], [160.0, 120.0]])


def test_own_variances_and_what_no_match_knows_add_up():
    noise = MeasurementNoise(TrackerConfig()).of_matches(_matches())
    expected = (SIGMAS**2 + UNMODELLED**2)[:, None, None] * np.eye(3)
    assert noise == pytest.approx(expected)


def test_covariances_keep_their_axes():
    covariance = np.tile(np.array([[0.5, 0.2], [0.2, 0.3]]), (4, 1, 1))
    added = MeasurementNoise(TrackerConfig()).of_matches(_matches(covariance))[:, :2, :2] - covariance
    assert added == pytest.approx(np.tile(UNMODELLED**2 * np.eye(2), (4, 1, 1)))


def test_keyframes_and_matches_have_the_same_variance_of_disparity():
    noise = MeasurementNoise(TrackerConfig())
    of_keypoints = noise.of_keypoints(_view(), np.arange(4))
    assert of_keypoints[:, 2:].sum(axis=1) == pytest.approx(noise.of_matches(_matches())[:, 2, 2])
    assert of_keypoints[:, 3] == pytest.approx(4.0 * of_keypoints[:, 2])  # the shared share is 0.8


def test_a_keyframe_s_own_place_weighs_less_than_any_match():
    """The landmark is what the keyframe's patch shows: its place must not level the sigmas of matches."""
    noise = MeasurementNoise(TrackerConfig())
    assert (noise.of_keypoints(_view(), np.arange(4))[:, 0] < noise.of_matches(_matches())[:, 0, 0]).all()


def test_what_views_share_and_what_they_do_not_is_the_whole():
    noise = MeasurementNoise(TrackerConfig())
    whole = noise.of_matches(_matches())
    alone, common = noise.split(whole)
    places = alone[:, :2, :2] + common[:, :2] @ common[:, :2].transpose(0, 2, 1)
    assert places == pytest.approx(whole[:, :2, :2])
    assert alone[:, 2, 2] == pytest.approx(0.2 * whole[:, 2, 2])


def test_a_constant_stands_in_place_of_all():
    noise = MeasurementNoise(TrackerConfig(constant_sigma=(0.15, 0.2)))
    expected = np.broadcast_to(np.diag([0.15, 0.15, 0.2]) ** 2, (4, 3, 3))
    assert noise.of_matches(_matches()) == pytest.approx(expected)
    assert noise.of_keypoints(_view(), np.arange(4))[:, 2:].sum(axis=1) == pytest.approx(0.2**2)


def _matches(covariance: np.ndarray | None = None) -> TemporalMatches:
    if covariance is None:
        covariance = SIGMAS[:, None, None] ** 2 * np.eye(2)
    return TemporalMatches(np.arange(4), PLACES, np.full(4, 12.0), covariance, SIGMAS, np.ones(4))


def _view() -> StereoView:
    image = np.zeros((240, 320), np.uint8)
    features = Features(PLACES, np.zeros((4, 0), np.float32), np.ones(4), np.full(4, 0.1))
    return StereoView(image, image, features, np.full(4, 12.0), SIGMAS)

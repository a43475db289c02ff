"""Noise of what is measured: a match's own, and what the calibration leaves open at its place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmaslam.estimation.calibration_errors import CalibrationPrior
from sigmaslam.frontend import TemporalMatches
from sigmaslam.frontend.types import Features, StereoView
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.measurement_noise import MeasurementNoise

CAMERA = RectifiedStereo(fx=400.0, fy=400.0, cx=319.5, cy=239.5, baseline=0.2, width=640, height=480)
MEASURED = np.array([[319.5, 239.5, 0.0], [600.0, 40.0, 10.0], [30.0, 460.0, 25.0], [580.0, 239.5, 4.0]])
OWN = 0.05
TURN = CalibrationSigmas(focal=0.003, principal_point=0.002, baseline=0.001, rotation=0.0003, distortion=0.0)


def test_an_exact_calibration_adds_nothing():
    noise = _noise(CalibrationSigmas.none())
    assert noise.of_matches(_matches(MEASURED))[:, 2, 2] == pytest.approx(OWN**2)
    assert noise.of_keypoints(_view(), np.arange(4))[:, 2:].sum(axis=1) == pytest.approx(OWN**2)


def test_a_turned_right_eye_adds_the_variance_that_projection_gives():
    """Independent: rays of the right eye are turned and projected; the offset, which is estimated, is taken off."""
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(TURN.rotation * rng.standard_normal((20_000, 3))).as_matrix()
    places = np.vstack([[CAMERA.cx, CAMERA.cy, 0.0], MEASURED])
    u, v, disparity = places.T
    ray = np.column_stack([(u - disparity - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))])
    turned = np.einsum("kij,mj->kmi", turns, ray)
    moved = CAMERA.fx * (turned[..., 0] / turned[..., 2] - ray[:, 0])
    expected = np.var(moved[:, 1:] - moved[:, :1], axis=0)
    added = _noise(TURN).of_matches(_matches(MEASURED))[:, 2, 2] - OWN**2
    assert added == pytest.approx(expected, rel=0.05, abs=1e-12)
    assert added.max() > 0.1**2


def test_what_both_eyes_share_adds_nothing():
    """Focal length, principal point and baseline scale all disparities alike: no match is worse than another."""
    shared = CalibrationSigmas(focal=0.01, principal_point=0.01, baseline=0.01, rotation=0.0, distortion=0.0)
    assert _noise(shared).of_matches(_matches(MEASURED))[:, 2, 2] == pytest.approx(OWN**2)


def test_an_error_that_is_estimated_is_not_counted_again():
    considered, estimated = (_noise(TURN, names) for names in ((), ("yaw", "pitch", "roll")))
    assert considered.of_matches(_matches(MEASURED))[1, 2, 2] > OWN**2
    assert estimated.of_matches(_matches(MEASURED))[:, 2, 2] == pytest.approx(OWN**2)


def test_keyframes_and_matches_have_the_same_variance_at_the_same_place():
    noise = _noise(CalibrationSigmas())
    of_keypoints = noise.of_keypoints(_view(), np.arange(4))
    assert of_keypoints[:, 2:].sum(axis=1) == pytest.approx(noise.of_matches(_matches(MEASURED))[:, 2, 2])
    assert of_keypoints[:, 3] == pytest.approx(4.0 * of_keypoints[:, 2])  # the shared share is 0.8


def test_a_missing_disparity_leaves_the_others_as_they_are():
    measured = MEASURED.copy()
    measured[1, 2] = np.nan
    noise = _noise(CalibrationSigmas())
    found, whole = (noise.of_matches(_matches(each)) for each in (measured, MEASURED))
    assert np.isfinite(found).all()
    assert found[[0, 2, 3]] == pytest.approx(whole[[0, 2, 3]])


def test_a_constant_stands_in_place_of_all():
    noise = MeasurementNoise(TrackerConfig(constant_sigma=(0.15, 0.2)), CAMERA, _prior(CalibrationSigmas()))
    expected = np.broadcast_to(np.diag([0.15, 0.15, 0.2]) ** 2, (4, 3, 3))
    assert noise.of_matches(_matches(MEASURED)) == pytest.approx(expected)
    assert noise.of_keypoints(_view(), np.arange(4))[:, 2:].sum(axis=1) == pytest.approx(0.2**2)


def _prior(sigmas: CalibrationSigmas, estimate: tuple[str, ...] = ()) -> CalibrationPrior:
    return CalibrationPrior.of(CAMERA, sigmas, 0.5, estimate)


def _noise(sigmas: CalibrationSigmas, estimate: tuple[str, ...] = ()) -> MeasurementNoise:
    return MeasurementNoise(TrackerConfig(), CAMERA, _prior(sigmas, estimate))


def _matches(measured: np.ndarray) -> TemporalMatches:
    count = len(measured)
    place = np.tile(OWN**2 * np.eye(2), (count, 1, 1))
    sigma = np.where(np.isfinite(measured[:, 2]), OWN, np.nan)
    return TemporalMatches(np.arange(count), measured[:, :2], measured[:, 2], place, sigma, np.ones(count))


def _view() -> StereoView:
    count, image = len(MEASURED), np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    features = Features(MEASURED[:, :2], np.zeros((count, 0), np.float32), np.ones(count), np.full(count, 0.1))
    return StereoView(image, image, features, MEASURED[:, 2], np.full(count, OWN))

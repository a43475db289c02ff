"""The default lens describes the whole image, and sigmas widen with the resamples of images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.calibration.board_bundle import Rig
from sigmaslam.calibration.calibrate import BoardCalibration, calibrate
from sigmaslam.calibration.image_bootstrap import bootstrap_rigs, widened
from sigmaslam.calibration.lens_choice import calibrate_whole_images, folds
from sigmaslam.geometry.camera import CameraModel
from tests.support.simulated_board import CHESSBOARD, FISHEYE, RADTAN, board_poses, seen_corners, views_of

SIZE = (640, 480)


def seen(eye: CameraModel, depth: float, reach: float = 1.0) -> tuple[list[str], list]:
    """Views of one camera with noise, of the middle of the image alone where the reach is below 1."""
    rig = Rig((eye,), np.eye(4))
    corners = seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 12, seed=1, depth=depth))
    noisy = corners.pixels + 0.1 * np.random.default_rng(0).standard_normal(corners.pixels.shape)
    middle = np.all(np.abs(noisy / SIZE - 0.5) < 0.5 * reach, axis=1)
    views = views_of(rig, CHESSBOARD, replace(corners, pixels=np.where(middle[:, None], noisy, -1.0)))
    return [str(k) for k in range(len(views))], views


def test_a_lens_that_turns_back_folds_and_one_that_does_not_does_not():
    assert not folds(RADTAN)
    assert folds(replace(RADTAN, distortion=(-0.6, 0.0, 0.0, 0.0)))
    assert not folds(FISHEYE)


@pytest.mark.long
def test_the_usual_lens_is_taken_where_it_does_not_fold():
    names, views = seen(RADTAN, 0.45)
    result = calibrate_whole_images(names, views, CHESSBOARD.points, [SIZE])
    assert len(result.rig.eyes[0].distortion) == 5
    assert result.rig.eyes[0].distortion_model == "radtan"


@pytest.mark.long
def test_another_lens_is_taken_where_the_usual_one_folds():
    """A fisheye whose board never reached the border: a polynomial of the tangent turns back out there."""
    names, views = seen(replace(FISHEYE, fx=260.0, fy=260.0), 0.3, reach=0.75)
    assert folds(calibrate(names, views, CHESSBOARD.points, [SIZE], "radtan5").rig.eyes[0])
    result = calibrate_whole_images(names, views, CHESSBOARD.points, [SIZE])
    assert not folds(result.rig.eyes[0])
    assert result.rms < 0.2


@pytest.fixture(scope="module")
def calibrated() -> BoardCalibration:
    names, views = seen(RADTAN, 0.45)
    return calibrate(names, views, CHESSBOARD.points, [SIZE], "radtan4")


@pytest.mark.long
def test_sigmas_widen_where_resamples_scatter_more_and_correlations_stay(calibrated: BoardCalibration):
    count = len(calibrated.sigmas)
    spread = np.ones(count)
    spread[3] = 4.0
    result = widened(calibrated, np.outer([1.0, -1.0], spread * calibrated.sigmas))
    expected = np.ones(count)
    expected[3] = 2.0
    np.testing.assert_allclose(result.sigmas / calibrated.sigmas, expected)
    np.testing.assert_allclose(correlation(result.covariance), correlation(calibrated.covariance), atol=1e-12)


@pytest.mark.long
def test_resamples_scatter_as_the_sigmas_say(calibrated: BoardCalibration):
    ratios = bootstrap_rigs(calibrated, 40, seed=0).std(axis=0) / calibrated.sigmas
    assert np.all(ratios < 2.0)
    assert np.all(ratios > 0.4)


def correlation(covariance: np.ndarray) -> np.ndarray:
    sigmas = np.sqrt(np.diag(covariance))
    return covariance / np.outer(sigmas, sigmas)

"""What errors of a calibration do to measurements, against pairs of cameras that really have them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.estimation.calibration_errors import ERRORS, OF_PAIR, CalibrationPrior, measured_errors
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import rotation_exp
from tests.support.dense_window import CAMERA

EYE = CameraModel(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
POINTS = np.random.default_rng(0).uniform((-3.0, -2.0, 4.0), (3.0, 2.0, 12.0), (200, 3))
# By how much an error is varied: a share, or radians.
STEP = 1e-5


def seen(
    left: CameraModel = EYE,
    right: CameraModel = EYE,
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    baseline: float = CAMERA.baseline,
) -> np.ndarray:
    """(u, v, disparity) (200, 3) of a pair whose right camera is turned by (3,) radians about its own axes."""
    in_left = left.project(POINTS)
    in_right = right.project((POINTS - [baseline, 0.0, 0.0]) @ rotation_exp(np.array(turn)))
    return np.column_stack([in_left, in_left[:, 0] - in_right[:, 0]])


def longer(share: float) -> CameraModel:
    """An eye with a longer focal length."""
    return replace(EYE, fx=EYE.fx * (1.0 + share), fy=EYE.fy * (1.0 + share))


def distorted(k1: float = 0.0, p1: float = 0.0, p2: float = 0.0) -> CameraModel:
    """An eye with a lens."""
    return replace(EYE, distortion_model="radtan", distortion=(k1, 0.0, p1, p2))


def moved(u: float = 0.0, v: float = 0.0) -> CameraModel:
    """An eye with its principal point so many pixels elsewhere."""
    return replace(EYE, cx=EYE.cx + u, cy=EYE.cy + v)


# By name: the pair with an error of that size, and the errors of the table that are as large as one of size one.
FX = CAMERA.fx
PAIRS: dict[str, tuple[Callable[[float], np.ndarray], dict[str, float]]] = {
    "right yaws": (lambda size: seen(turn=(0.0, size, 0.0)), {"yaw": FX, "offset": FX}),
    "right pitches": (lambda size: seen(turn=(size, 0.0, 0.0)), {"pitch": -FX}),
    "right rolls": (lambda size: seen(turn=(0.0, 0.0, size)), {"roll": -FX}),
    "right is longer": (lambda size: seen(right=longer(size)), {"zoom": -FX}),
    "right's lens is stronger": (lambda size: seen(right=distorted(k1=size)), {"lenses": -FX}),
    "right's lens sits too high": (lambda size: seen(right=distorted(p1=size)), {"pitch": -2.0 * FX}),
    "right's lens sits aside": (lambda size: seen(right=distorted(p2=size)), {"yaw": -3.0 * FX, "bend": -FX}),
    "right's centre is elsewhere": (lambda size: seen(right=moved(u=size)), {"offset": -1.0}),
    "both are longer": (lambda size: seen(longer(size), longer(size)), {"focal": 1.0}),
    "both lenses are stronger": (lambda size: seen(distorted(size), distorted(size)), {"lens": FX}),
    "both centres are aside": (lambda size: seen(moved(u=size), moved(u=size)), {"centre_u": 1.0}),
    "both centres are lower": (lambda size: seen(moved(v=size), moved(v=size)), {"centre_v": 1.0}),
    "eyes are farther apart": (lambda size: seen(baseline=CAMERA.baseline * (1.0 + size)), {"baseline": 1.0}),
}


@pytest.mark.parametrize("pair", PAIRS)
def test_errors_are_what_a_pair_with_them_measures_differently(pair: str):
    """By finite differences of two cameras that are not the calibrated ones."""
    measure, sizes = PAIRS[pair]
    difference = (measure(STEP) - measure(-STEP)) / (2 * STEP)
    expected = measured_errors(CAMERA, seen()) @ [sizes.get(name, 0.0) for name in ERRORS]
    assert np.abs(expected).max() > 0.5
    np.testing.assert_allclose(difference, expected, atol=1e-6 * np.abs(expected).max())


def test_every_error_is_that_of_some_pair():
    assert {name for _, sizes in PAIRS.values() for name in sizes} == set(OF_PAIR)


def test_errors_are_told_apart_by_what_is_measured():
    """No two of the table do the same to all points."""
    errors = measured_errors(CAMERA, seen()).reshape(-1, len(ERRORS))[:, : len(OF_PAIR)]
    assert np.linalg.matrix_rank(errors / np.linalg.norm(errors, axis=0)) == len(OF_PAIR)


def test_a_missing_disparity_leaves_the_places_their_errors():
    uvd = seen()
    whole = measured_errors(CAMERA, uvd)[:, :2]
    uvd[:, 2] = np.nan
    np.testing.assert_array_equal(measured_errors(CAMERA, uvd)[:, :2], whole)


def test_the_prior_of_a_pair_is_in_pixels_where_its_errors_are():
    """Each sigma of a calibration moves its errors alone, as a pair with an error so large would.

    The others have a share of usual ones, which errors of following look like.
    """
    offset = 0.7
    least = dict(zip(OF_PAIR, 0.07 * CalibrationPrior.of(CAMERA, CalibrationSigmas(), 0.0).sigma, strict=False))
    for name, errors, scale in (
        ("rotation", ("yaw", "pitch", "roll"), CAMERA.fx),
        ("distortion", ("zoom", "bend", "lenses", "lens"), CAMERA.fx),
        ("focal", ("focal",), 1.0),
        ("principal_point", ("centre_u", "centre_v"), CAMERA.fx),
        ("baseline", ("baseline",), 1.0),
    ):
        prior = CalibrationPrior.of(CAMERA, replace(CalibrationSigmas.none(), **{name: 0.01}), offset)
        expected = least | dict.fromkeys(errors, 0.01 * scale) | {"offset": offset}
        np.testing.assert_allclose(prior.sigma[: len(OF_PAIR)], [expected[each] for each in OF_PAIR])


def test_what_is_not_estimated_is_considered():
    sigma = np.arange(1.0, len(ERRORS) + 1.0)
    prior = CalibrationPrior.independent(sigma, "offset", "pitch")
    assert [name for name, is_it in zip(ERRORS, prior.estimated, strict=True) if is_it] == ["offset", "pitch"]
    considered = prior.considered_factor @ prior.considered_factor.T
    np.testing.assert_allclose(prior.estimated_covariance + considered, np.diag(sigma**2))
    assert not (prior.estimated_covariance @ considered).any()
    of_pair = CalibrationPrior.of(CAMERA, CalibrationSigmas(), 0.5)
    assert np.flatnonzero(of_pair.estimated_covariance.any(axis=0)).tolist() == [0]
    of_exact = CalibrationPrior.of(CAMERA, CalibrationSigmas.none(), 0.5).considered_factor
    assert np.flatnonzero(of_exact.any(axis=0)).tolist() == list(range(1, len(ERRORS)))

"""The covariance of a calibration, from its file to the tracker's prior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sigmaslam.calibration_files.calibration_writer import write_calibration
from sigmaslam.errors import CalibrationError
from sigmaslam.estimation.calibration_errors import ERRORS, CalibrationPrior
from sigmaslam.geometry.calibration_covariance import CalibrationCovariance
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import StereoCamera
from tests.support.dense_window import CAMERA as RECTIFIED
from tests.support.simulated_stereo import parallel_camera

NAMES = ("focal", "yaw", "baseline")
MATRIX = np.array([[4e-6, 1e-7, -5e-7], [1e-7, 9e-8, 0.0], [-5e-7, 0.0, 1e-6]])
KNOWN = CalibrationCovariance(NAMES, MATRIX)


def test_a_covariance_survives_a_file(tmp_path: Path):
    camera = replace(parallel_camera(640, 480, 500.0, 0.1), covariance=KNOWN)
    write_calibration(tmp_path / "stereo.yaml", camera, {"residuals": {"rms": 0.2}})
    found = StereoCamera.from_yaml(tmp_path / "stereo.yaml")
    assert found.covariance is not None
    assert found.covariance.names == NAMES
    np.testing.assert_array_equal(found.covariance.matrix, MATRIX)
    write_calibration(tmp_path / "without.yaml", replace(camera, covariance=None))
    assert StereoCamera.from_yaml(tmp_path / "without.yaml").covariance is None


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (3, "key 'covariance' must be a mapping, got 3"),
        ({"names": ["focal"]}, r"key 'covariance.matrix' is missing"),
        ({"names": "focal", "matrix": [[1]]}, "names must be a list of offset, yaw"),
        ({"names": ["fokal"], "matrix": [[1]]}, "covariance names fokal; known are offset, yaw"),
        ({"names": ["yaw", "yaw"], "matrix": [[1, 0], [0, 1]]}, "covariance names an error twice: yaw, yaw"),
        ({"names": ["yaw"], "matrix": [[1, 0], [0, 1]]}, "covariance has 1 names and a matrix of 2x2"),
        ({"names": ["yaw", "roll"], "matrix": [[1, 0.5], [0, 1]]}, "is not symmetric"),
        ({"names": ["yaw", "roll"], "matrix": [[1, 2], [2, 1]]}, "has a negative eigenvalue"),
        ({"names": ["yaw"], "matrix": [[-1]]}, "has a negative eigenvalue"),
        ({"names": ["yaw"], "matrix": [[1]], "units": "m"}, "covariance: unknown key units; known are names, matrix"),
    ],
)
def test_errors_name_file_key_and_value(tmp_path: Path, covariance: Any, message: str):
    path = tmp_path / "stereo.yaml"
    write_calibration(path, parallel_camera(640, 480, 500.0, 0.1))
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"covariance": covariance}))
    with pytest.raises(CalibrationError, match=message) as caught:
        StereoCamera.from_yaml(path)
    assert str(caught.value).count(str(path)) == 1


def test_the_prior_has_the_covariance_where_the_file_names_errors():
    prior = CalibrationPrior.of(RECTIFIED, CalibrationSigmas(), 0.7, covariance=KNOWN)
    default = CalibrationPrior.of(RECTIFIED, CalibrationSigmas(), 0.7)
    focal, yaw, baseline = (ERRORS.index(name) for name in NAMES)
    assert prior.covariance[focal, focal] == pytest.approx(4e-6)
    assert prior.covariance[focal, yaw] == pytest.approx(1e-7 * RECTIFIED.fx)
    assert prior.covariance[yaw, yaw] == pytest.approx(9e-8 * RECTIFIED.fx**2)
    others = [k for k in range(len(ERRORS)) if k not in (focal, yaw, baseline)]
    np.testing.assert_array_equal(prior.sigma[others], default.sigma[others])
    assert prior.covariance[np.ix_(others, (focal, yaw, baseline))].any() == np.False_


@pytest.mark.parametrize("estimate", [(), ("yaw",), ("focal", "baseline")])
def test_estimated_and_considered_parts_make_up_the_prior(estimate: tuple[str, ...]):
    prior = CalibrationPrior.of(RECTIFIED, CalibrationSigmas(), 0.7, estimate, KNOWN)
    factor = prior.considered_factor
    np.testing.assert_allclose(prior.estimated_covariance + factor @ factor.T, prior.covariance, rtol=1e-9, atol=1e-15)
    # A considered error that becomes an estimated one takes a column of its own.
    assert not factor[:, prior.estimated].any()
    assert not factor[prior.estimated].any()


def test_independent_errors_are_those_that_sigmas_give():
    sigmas = CalibrationSigmas()
    same = CalibrationCovariance(("focal", "baseline"), np.diag([sigmas.focal**2, sigmas.baseline**2]))
    with_covariance = CalibrationPrior.of(RECTIFIED, sigmas, 0.7, covariance=same)
    np.testing.assert_allclose(
        with_covariance.considered_factor, CalibrationPrior.of(RECTIFIED, sigmas, 0.7).considered_factor, atol=1e-15
    )

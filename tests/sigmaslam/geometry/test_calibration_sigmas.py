"""How well a calibration is known, as its file says."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from tests.support.calibration_yaml import write_calibration
from tests.support.simulated_stereo import parallel_camera

CAMERA = parallel_camera(640, 480, 500.0, 0.1)


def written(tmp_path: Path, *sigmas: Any) -> Path:
    """A calibration file with these `sigmas`, or without the key."""
    path = tmp_path / "stereo.yaml"
    write_calibration(CAMERA, path)
    content = yaml.safe_load(path.read_text())
    del content["sigmas"]
    if sigmas:
        content["sigmas"] = sigmas[0]
    path.write_text(yaml.safe_dump(content))
    return path


def read(path: Path) -> CalibrationSigmas:
    return StereoCamera.from_yaml(path).sigmas


def test_a_calibration_is_as_good_as_most_unless_it_says_otherwise(tmp_path: Path):
    default = CalibrationSigmas()
    assert all(value > 0.0 for value in asdict(default).values())
    assert read(written(tmp_path)) == default
    assert read(written(tmp_path, {})) == default
    eye = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    assert StereoCamera(eye, eye, CAMERA.T_left_right).sigmas == default


@pytest.mark.parametrize("zero", [0, 0.0, "0"])
def test_zero_is_a_calibration_without_errors(tmp_path: Path, zero: Any):
    found = read(written(tmp_path, zero))
    assert found == CalibrationSigmas.none()
    assert not any(asdict(found).values())


def test_what_is_named_is_set_and_the_rest_as_by_default(tmp_path: Path):
    expected = replace(CalibrationSigmas(), focal=0.01, rotation=1e-4, baseline=0.0)
    assert read(written(tmp_path, {"focal": 0.01, "rotation": "1e-4", "baseline": 0})) == expected


def test_a_way_that_is_a_per_cent_too_long_is_within_three_sigmas():
    """No image shows a baseline that is wrong: only its sigma can tell."""
    default = CalibrationSigmas()
    assert 0.01 <= 3.0 * np.hypot(default.baseline, default.focal) <= 0.02


def test_sigmas_survive_a_file(tmp_path: Path):
    sigmas = CalibrationSigmas(0.011, 0.012, 0.013, 0.014, 0.015)
    write_calibration(replace(CAMERA, sigmas=sigmas), tmp_path / "stereo.yaml")
    assert read(tmp_path / "stereo.yaml") == sigmas


@pytest.mark.parametrize(
    ("sigmas", "message"),
    [
        (0.003, r"sigmas is 0.003: give 0, or a mapping such as \{focal: 0.003"),
        (-1, "sigmas is -1: give 0, or a mapping"),
        ("good", "key 'sigmas' must be a number, got good"),
        ([0.1, 0.2], r"key 'sigmas' must be a number, got \[0.1, 0.2\]"),
        (True, "key 'sigmas' must be a number, got True"),
        ({"fokal": 0.1}, "sigmas: unknown key fokal; known are focal, principal_point, baseline, rotation, distortion"),
        ({"focal": -0.1}, "sigmas: focal is -0.1: a standard deviation is zero or more"),
        ({"focal": "wide"}, "key 'sigmas.focal' must be a number, got wide"),
        ({"rotation": [0.1, 0.2, 0.3]}, r"key 'sigmas.rotation' must be a number, got \[0.1, 0.2, 0.3\]"),
        ({"baseline": float("nan")}, "key 'sigmas.baseline' must be a number, got nan"),
        ({"distortion": float("inf")}, "key 'sigmas.distortion' must be a number, got inf"),
    ],
)
def test_errors_name_file_key_and_value(tmp_path: Path, sigmas: Any, message: str):
    path = written(tmp_path, sigmas)
    with pytest.raises(CalibrationError, match=message) as caught:
        read(path)
    assert str(caught.value).count(str(path)) == 1

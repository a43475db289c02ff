"""A calibration that a run has learned: the next run finds nothing wrong with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sigmaslam.calibration.learned_calibration import learned_calibration
from sigmaslam.calibration.tracker_covariance import nearest_errors
from sigmaslam.calibration_files.calibration_writer import write_calibration
from sigmaslam.estimation.calibration_errors import ERRORS, CalibrationPrior
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.slam.estimate import CalibrationEstimate
from sigmaslam_benchmarks.live.calibration_faults import CALIBRATION_FAULTS
from tests.support.calibration_forms import raw_rig

PINHOLE = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)


def rectified_pair() -> StereoCamera:
    T = np.eye(4)
    T[0, 3] = 0.2
    return StereoCamera(PINHOLE, PINHOLE, T)


def test_disparities_lose_their_offset():
    """A point at 2 m: 50 px, measured as 50.7."""
    learned = learned_calibration(rectified_pair(), CalibrationEstimate(0.7, 0.05), 500.0)
    point = np.array([[0.3, 0.1, 2.0]])
    left, right = learned.left.project(point), learned.right.project(point - [0.2, 0.0, 0.0])
    assert (left - right)[0, 0] == pytest.approx(50.7)


def test_rows_of_a_bump_are_of_the_right_principal_point():
    """As images that are raised by two rows: a point is seen in one row by both eyes."""
    learned = learned_calibration(rectified_pair(), CalibrationEstimate(0.0, 0.05, raised=2.0), 500.0)
    point = np.array([[0.3, 0.1, 2.0]])
    assert learned.right.project(point)[0, 1] == pytest.approx(learned.left.project(point)[0, 1] + 2.0)


def test_the_next_run_begins_with_what_is_still_unknown(tmp_path: Path):
    learned = learned_calibration(raw_rig("radtan"), CalibrationEstimate(-0.4, 0.05), 450.0)
    write_calibration(tmp_path / "learned.yaml", learned)
    read = StereoCamera.from_yaml(tmp_path / "learned.yaml")
    rectified = StereoRectifier(read).rectified
    prior = CalibrationPrior.of(rectified, read.sigmas, 0.5, covariance=read.covariance)
    assert prior.sigma[0] == pytest.approx(0.05 * rectified.fx / 450.0)
    assert prior.estimated[0]
    assert prior.sigma[1] == pytest.approx(rectified.fx * read.sigmas.rotation)


def test_a_baseline_that_made_up_for_the_offset_is_corrected():
    learned = learned_calibration(rectified_pair(), CalibrationEstimate(3.0, 0.1, {"baseline": (-0.06, 0.06)}), 500.0)
    assert learned.T_left_right[0, 3] == pytest.approx(0.2 * 0.94)
    assert learned.covariance is not None
    assert dict(zip(learned.covariance.names, np.sqrt(np.diag(learned.covariance.matrix)), strict=True)) == {
        "offset": pytest.approx(0.0002),
        "baseline": pytest.approx(0.06),
    }


def test_learning_once_more_keeps_what_else_is_known():
    once = learned_calibration(rectified_pair(), CalibrationEstimate(3.0, 0.1, {"baseline": (-0.06, 0.06)}), 500.0)
    twice = learned_calibration(once, CalibrationEstimate(0.01, 0.02), 500.0)
    assert twice.covariance is not None
    sigmas = dict(zip(twice.covariance.names, np.sqrt(np.diag(twice.covariance.matrix)), strict=True))
    assert sigmas == {"baseline": pytest.approx(0.06), "offset": pytest.approx(0.02 / 500.0)}
    assert replace(twice, covariance=once.covariance).right.cx == pytest.approx(once.right.cx - 0.01)


def test_a_lens_that_cannot_be_corrected_is_as_unknown_as_before():
    learned = learned_calibration(
        raw_rig("equidistant"), CalibrationEstimate(0.0, 0.05, {}, {"lenses": (1.0, 0.01, 1e-4)}), 450.0
    )
    assert learned.covariance.names == ("offset",)


@pytest.mark.parametrize("name", ["yaw", "zoom", "lenses"])
def test_what_is_wrong_by_the_evidence_is_corrected(name: str):
    """The errors of a pair that is given with one, as a run with no noise would find them, leave the true pair."""
    true = rectified_pair()
    fault = {"yaw": "yaw_0.1", "zoom": "zoom_1", "lenses": "k1_0.01"}[name]
    given = CALIBRATION_FAULTS[fault].miscalibrate(true)
    focal, errors = StereoRectifier(given).rectified.fx, nearest_errors(given, true)
    share = float(errors[ERRORS.index(name)]) / focal
    estimate = CalibrationEstimate(float(errors[0]), 0.01, {}, {name: (1.0, share, 1e-4)})
    learned = learned_calibration(given, estimate, focal)
    left = np.abs(nearest_errors(learned, true))
    assert left[1:7].max() < 0.1 * np.abs(errors[:7]).max()
    assert left[0] < 0.1 * np.abs(errors[:7]).max()
    sigmas = dict(zip(learned.covariance.names, np.sqrt(np.diag(learned.covariance.matrix)), strict=True))
    assert sigmas == {name: pytest.approx(1e-4), "offset": pytest.approx(0.01 / focal)}


@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.0, 0.0), (-0.283, 0.074, 0.0, 0.0)])
@pytest.mark.parametrize(("both", "right_less"), [(0.02, 0.0), (-0.03, 0.0), (0.0, 0.01), (0.01, -0.01)])
def test_lenses_are_corrected_whatever_else_they_bend(lens: tuple[float, ...], both: float, right_less: float):
    """At the edge of a barrel k1 moves rays by three times as much as in the middle."""
    true = replace(rectified_pair(), **dict.fromkeys(("left", "right"), replace(PINHOLE, **radial(lens))))
    bent = [replace(PINHOLE, **radial((lens[0] + k1, *lens[1:]))) for k1 in (both, both - right_less)]
    given = replace(true, left=bent[0], right=bent[1])
    focal, errors = StereoRectifier(given).rectified.fx, nearest_errors(given, true)
    rows = [ERRORS.index("lens"), ERRORS.index("lenses")]
    found = {ERRORS[k]: (1.0, float(errors[k]) / focal, 1e-4) for k in rows}
    learned = learned_calibration(given, CalibrationEstimate(float(errors[0]), 0.01, {}, found), focal)
    assert np.abs(nearest_errors(learned, true)[rows]).max() < 0.1 * np.abs(errors[rows]).max()
    assert learned.left.distortion[0] == pytest.approx(lens[0], abs=0.2 * abs(both) + 0.1 * abs(right_less))
    assert learned.covariance.names == ("lens", "lenses", "offset")


def radial(distortion: tuple[float, ...]) -> dict[str, Any]:
    return {"distortion_model": "radtan", "distortion": distortion}

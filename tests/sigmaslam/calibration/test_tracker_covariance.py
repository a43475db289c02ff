"""What the tracker considers of a calibration's parameters, against pairs of which the errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.calibration.board_bundle import Rig
from sigmaslam.calibration.tracker_covariance import tracker_covariance
from sigmaslam.estimation.calibration_errors import OF_PAIR
from sigmaslam.geometry.calibration_covariance import ERROR_NAMES
from sigmaslam.geometry.camera import CameraModel
from tests.support.simulated_board import RADTAN, stereo_rig

PINHOLE = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)


def parallel_rig() -> Rig:
    """Two equal pinhole cameras."""
    T = np.eye(4)
    T[0, 3] = 0.2
    return Rig((PINHOLE, PINHOLE), T)


def errors_of(rig: Rig, *changes: dict[str, float]) -> dict[str, float]:
    """Standard deviations of the tracker's errors, from independent changes of parameters that go together."""
    factor = np.array([[change.get(name, 0.0) for name in rig.names] for change in changes])
    assert all(name in rig.names for change in changes for name in change)
    result, share = tracker_covariance(rig, factor.T @ factor)
    assert share > 0.98
    return dict(zip(result.names, np.sqrt(np.diag(result.matrix)).tolist(), strict=True))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"T_left_right.x": 0.2 * 1e-3}, {"baseline": 1e-3}),
        ({"left.fx": 0.5, "left.fy": 0.5, "right.fx": 0.5, "right.fy": 0.5}, {"focal": 1e-3}),
        ({"left.cx": 0.5, "right.cx": 0.5}, {"centre_u": 1e-3}),
        ({"left.cy": 0.5, "right.cy": 0.5}, {"centre_v": 1e-3}),
        ({"right.fx": 0.5, "right.fy": 0.5}, {"zoom": 1e-3}),
    ],
    ids=["baseline", "focal", "centre_u", "centre_v", "zoom"],
)
def test_each_change_of_the_cameras_is_the_error_of_its_name(change: dict[str, float], expected: dict[str, float]):
    found = errors_of(parallel_rig(), change)
    for name in ERROR_NAMES:
        assert found[name] == pytest.approx(expected.get(name, 0.0), rel=1e-3, abs=2e-6), name


def test_turns_about_the_axes_of_the_right_camera_are_pitch_yaw_and_roll():
    # A turn about the left camera moves the right one, which its place takes back.
    for change, name in (
        ({"T_left_right.turn_x": 1e-3}, "pitch"),
        ({"T_left_right.turn_y": 1e-3, "T_left_right.z": 0.2e-3}, "yaw"),
        ({"T_left_right.turn_z": 1e-3, "T_left_right.y": -0.2e-3}, "roll"),
    ):
        found = errors_of(parallel_rig(), change)
        assert found.pop(name) == pytest.approx(1e-3, rel=1e-3)
        assert max(found.values()) < 1e-5


def test_what_goes_together_stays_together():
    """Cameras that are longer where they stand farther apart."""
    rig = parallel_rig()
    longer = {f"{eye}.{f}": 0.5 for eye in ("left", "right") for f in ("fx", "fy")}
    factor = np.array([[(longer | {"T_left_right.x": 0.2e-3}).get(name, 0.0) for name in rig.names]])
    result, _ = tracker_covariance(rig, factor.T @ factor)
    focal, baseline = result.names.index("focal"), result.names.index("baseline")
    assert result.matrix[focal, baseline] == pytest.approx(1e-6, rel=1e-2)


def test_lenses_are_described_for_the_most_part():
    rig = stereo_rig(RADTAN)
    sigmas = np.array([2e-3 if name.endswith(".d0") else 0.0 for name in rig.names])
    _, share = tracker_covariance(rig, np.diag(sigmas**2))
    assert 0.95 < share <= 1.0


def test_the_names_are_the_tracker_s_without_the_offset():
    assert ("offset", *ERROR_NAMES) == OF_PAIR

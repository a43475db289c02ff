"""Faults of calibrations: what they are as errors of the tracker, late right images, and the page."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam_benchmarks.live.calibration_faults import CALIBRATION_FAULTS, injected_errors
from sigmaslam_benchmarks.live.calibration_page import format_calibration_page
from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT, DrivenFrame
from sigmaslam_benchmarks.live.judge import DrivenPose, References, judge
from sigmaslam_benchmarks.live.live_page import LivePage
from sigmaslam_benchmarks.live.recordings import Recording

COVARIANCE = 0.01 * np.eye(6)
EYE = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)
CAMERA = StereoCamera(EYE, EYE, np.array([[1.0, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("none", {}),
        ("centre_2", {"offset": 2.0}),
        ("yaw_0.1", {"offset": -500 * np.radians(0.1), "yaw": -500 * np.radians(0.1)}),
        ("zoom_0.5", {"zoom": 2.5}),
        ("baseline_1", {"baseline": -0.01}),
        ("k1_0.01", {"lenses": 5.0}),
        ("both_k1_0.01", {"lens": -5.0}),
        ("delay_5", {}),
    ],
)
def test_what_is_put_in_is_known(case: str, expected: dict[str, float]):
    found = injected_errors(CAMERA, case)
    assert found.keys() - expected.keys() <= {"zoom"}  # of a lens, a little
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=0.12)


def test_a_name_stands_for_one_fault_alone():
    assert CALIBRATION_FAULTS.keys() & FAULTS.keys() == {NO_FAULT}


def test_late_right_images_show_the_scene_as_it_has_moved_on():
    rng = np.random.default_rng(0)
    texture = np.kron(rng.uniform(0, 255, (20, 40)), np.ones((6, 6)))
    u = np.arange(160)
    images = [texture[:, np.round(u + 20 - 4 * k).astype(int)].astype(np.uint8) for k in range(3)]
    frames = [DrivenFrame(k, 0.1 * k, image, image) for k, image in enumerate(images)]
    late = CALIBRATION_FAULTS["delay_10"].spoil(frames, rng)
    assert len(late) == 2
    assert late[0].left is frames[0].left
    inner = slice(20, 140)
    # A tenth of 4 px: the image moves to the right.
    moved = late[0].right.astype(float) - images[0]
    slope = np.gradient(images[0].astype(float), axis=1)
    shift = -(moved * slope)[:, inner].sum() / (slope**2)[:, inner].sum()
    assert shift == pytest.approx(0.4, abs=0.15)


def test_the_page_shows_what_was_estimated_beside_what_is_true():
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 2, 3] = np.arange(12.0)
    longer = poses.copy()
    longer[:, 2, 3] *= 1.02
    given = {
        "none": judge([DrivenPose(k, "tracking", each, COVARIANCE) for k, each in enumerate(poses)], References(poses)),
        "baseline_2": judge(
            [DrivenPose(k, "tracking", each, COVARIANCE) for k, each in enumerate(longer)],
            References(poses),
            learned={"offset": (0.1, 0.05)},
        ),
    }
    room = Recording("room7", "room", 12, 7)
    found = {(room, "ours", case): each for case, each in given.items()}
    page = format_calibration_page(LivePage("sigmaslam benchmark calibration", list(given), ["ours"], found, 12, 3))
    assert "+0.00 -> +2.00 | 0.220 | 2.2 |" in page
    assert "offset +0.1 ± 0.05 (+0)" in page
    assert "**1 runs are missing" in page

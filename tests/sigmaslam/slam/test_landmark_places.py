from dataclasses import replace

import numpy as np

from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, transform_points
from sigmaslam.slam.landmark_places import landmark_places, seen_from
from tests.support.dense_window import CAMERA, DEPTH, NO_WALK, make_window

KEY = se3_exp(np.array([3.0, -1.0, 2.0, 0.4, -0.8, 0.2]))
VIEW = se3_exp(np.array([3.1, -1.0, 2.2, 0.4, -0.75, 0.2]))


def window_of(measured: np.ndarray) -> KeyframeWindow:
    window = make_window(np.ones(3))
    window.add_keyframe(KEY, KEY, 1e-6 * np.eye(6), NO_WALK, DEPTH)
    window.add_landmarks(np.arange(len(measured)), measured, np.full((len(measured), 4), 0.1))
    return window


def test_landmarks_are_seen_where_their_points_are() -> None:
    measured = np.array([[300.0, 200.0, 20.0], [100.0, 150.0, 30.0], [320.0, 240.0, -1.0]])
    rows = np.array([2, 1, 0])
    points = transform_points(se3_inverse(VIEW) @ KEY, CAMERA.triangulate(measured[:2]))
    seen = seen_from(window_of(measured), rows, VIEW)
    np.testing.assert_allclose(seen[1:], CAMERA.project(points)[::-1], rtol=1e-9)
    assert np.isnan(seen[0]).all()


def test_places_are_found_again_when_landmarks_or_calibration_change() -> None:
    window = window_of(np.array([[300.0, 200.0, 20.0]]))
    before = landmark_places(window)[0]
    assert landmark_places(window)[0] is before
    calibration = window.posterior.calibration.copy()
    calibration[0] += 0.5
    window.posterior = replace(window.posterior, calibration=calibration)
    np.testing.assert_allclose(landmark_places(window)[0], before - [0.0, 0.0, 0.5])
    window.add_landmarks(np.array([1]), np.array([[90.0, 80.0, 7.0]]), np.full((1, 4), 0.1))
    assert len(landmark_places(window)[0]) == 2
    window.solve()
    np.testing.assert_array_equal(landmark_places(window)[0], window.as_calibrated(window.landmarks.estimate))

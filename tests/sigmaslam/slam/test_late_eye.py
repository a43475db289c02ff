"""A right eye that is late by a known time."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.frontend.types import Features, StereoView
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log, transform_points
from sigmaslam.slam.late_eye import at_one_moment
from sigmaslam.slam.tracker import StereoTracker
from tests.support.simulated_frontend import SCALES, SimulatedFrontend, SimulatedRun, run_simulated

CAMERA = RectifiedStereo(700.0, 700.0, 620.0, 190.0, 0.54, 1240, 376)
SHARE = 0.1
"""Of a frame, by which the right eye is late."""


class LateFrontend(SimulatedFrontend):
    """Its right eye sees the points a tenth of a frame later."""

    def _project(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        at_once, inside = super()._project(frame)
        first, second = self.poses[max(frame - 1, 0)], self.poses[max(frame, 1)]
        way = SHARE * se3_log(se3_inverse(first) @ second)
        later, _ = self._project_from(self.poses[frame] @ se3_exp(way))
        return np.column_stack([at_once[:, :2], at_once[:, 0] - later[:, 0] + later[:, 2]]), inside


def view_of(uvd: np.ndarray) -> StereoView:
    count = len(uvd)
    features = Features(uvd[:, :2], np.zeros((count, 0)), np.ones(count), np.ones(count))
    image = np.zeros((2, 2), np.uint8)
    return StereoView(image, image, features, uvd[:, 2], np.ones(count))


@pytest.mark.parametrize(
    "way",
    [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.01, -0.02, 0.15, 0.001, 0.004, -0.002), (-0.05, 0.0, -0.1, 0.0, 0.0, 0.01)],
)
def test_disparities_are_those_of_one_moment(way: tuple[float, ...]):
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.uniform(60, 1240, 100), rng.uniform(0, 376, 100), rng.uniform(1, 60, 100)])
    later = CAMERA.project(transform_points(se3_inverse(se3_exp(np.array(way))), CAMERA.triangulate(truth)))
    late = truth[:, 0] - (later[:, 0] - later[:, 2])
    late[::10] = np.nan
    corrected = at_one_moment(view_of(np.column_stack([truth[:, :2], late])), CAMERA, np.array(way)).disparity
    np.testing.assert_array_equal(np.isnan(corrected), np.isnan(late))
    known = np.isfinite(late)
    np.testing.assert_allclose(corrected[known], truth[known, 2], atol=0.03)
    assert np.allclose(late[known], truth[known, 2]) == (not any(way))


def run(kind: str, seed: int, *, is_told: bool) -> SimulatedRun:
    scale = SCALES[kind]
    frontend, delay = LateFrontend(scale, seed, 20, 150), SHARE * scale.interval * is_told
    return run_simulated(StereoTracker(frontend.camera, frontend, right_delay=delay), frontend, scale)


def last_error(run: SimulatedRun) -> float:
    return float(np.linalg.norm(run.estimates[-1].T_world_camera[:3, 3] - run.poses[-1][:3, 3]))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["driving", "drone"])
def test_a_delay_that_is_told_is_corrected(kind: str):
    """By the velocity as it was predicted, which here wanders from frame to frame by half of what is allowed."""
    late, told = ([run(kind, seed, is_told=is_told) for seed in range(6)] for is_told in (False, True))
    assert np.mean([last_error(each) for each in told]) < 0.4 * np.mean([last_error(each) for each in late])
    assert np.mean([each.nees.mean() for each in late]) > 4.0
    assert np.mean([each.nees.mean() for each in told]) < 2.0
    assert all(e.status == "tracking" for each in told for e in each.estimates[1:])

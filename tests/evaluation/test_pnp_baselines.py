"""The odometry from OpenCV that the results are compared with."""

from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.camera import CameraModel, RectifiedStereo, StereoCamera
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam_benchmarks.tracking.pnp_baselines import PnpOdometry, pose_from_points
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error

CAMERA = RectifiedStereo(500.0, 510.0, 320.0, 240.0, 0.1, 640, 480)
T_KEY_CAMERA = se3_exp(np.array([0.3, -0.1, 0.5, 0.05, -0.1, 0.02]))


def _scene(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) in the keyframe, and the pixels (count, 2) where the camera sees them."""
    seen = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 10, count)])
    points = seen @ T_KEY_CAMERA[:3, :3].T + T_KEY_CAMERA[:3, 3]
    return points, CAMERA.project(seen)[:, :2]


def _error(T: np.ndarray) -> np.ndarray:
    return se3_log(se3_inverse(T) @ T_KEY_CAMERA)


def test_a_pose_of_known_points_is_found_exactly_among_outliers():
    rng = np.random.default_rng(1)
    points, pixels = _scene(rng, 200)
    wrong = np.arange(200) < 60
    pixels[wrong] += rng.uniform(20, 100, (60, 2))
    pose = pose_from_points(points, pixels, CAMERA)
    assert pose is not None
    np.testing.assert_allclose(_error(pose.T_key_camera), 0.0, atol=1e-6)
    np.testing.assert_array_equal(pose.inliers, ~wrong)


def test_the_covariance_is_right_when_the_points_are_known_and_the_noise_is_one_pixel():
    rng = np.random.default_rng(2)
    squares = []
    for _ in range(200):
        points, pixels = _scene(rng, 60)
        # Half a pixel is seldom cut off by the gate of two, as one pixel would be.
        pose = pose_from_points(points, pixels + 0.5 * rng.standard_normal(pixels.shape), CAMERA)
        assert pose is not None
        error = _error(pose.T_key_camera)
        squares.append(error @ np.linalg.solve(0.25 * pose.covariance, error) / 6)
    # The standard error of the mean is 0.04.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.15)


def test_too_few_points_give_no_pose():
    points, pixels = _scene(np.random.default_rng(3), 14)
    assert pose_from_points(points, pixels, CAMERA) is None


@pytest.mark.long
@pytest.mark.parametrize("matcher", ["sift", "klt"])
def test_the_demo_is_followed_to_a_centimetre(demo_sequence: Path, matcher: str):
    opened = open_sequence(demo_sequence)
    odometry = PnpOdometry(opened.camera, matcher)
    with closing(opened.frames()) as frames:
        pairs = list(islice(frames, 16))
    steps = [odometry.step(frame.left, frame.right) for frame in pairs]
    assert [step.status for step in steps] == ["starting"] + ["tracking"] * 15
    poses = np.stack([step.T_world_camera for step in steps])
    truth = read_trajectory(demo_sequence / "poses.txt").subset(np.arange(16))
    assert truth.path_length > 0.3
    assert absolute_trajectory_error(Trajectory(truth.timestamps, poses), truth).rmse < 0.01
    assert (np.linalg.eigvalsh(steps[-1].covariance) > 0).all()


@pytest.mark.parametrize("matcher", ["sift", "klt"])
def test_without_texture_it_says_that_it_is_lost(matcher: str):
    eye = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    T_left_right = np.eye(4)
    T_left_right[0, 3] = 0.1
    odometry = PnpOdometry(StereoCamera(eye, eye, T_left_right), matcher)
    grey = np.full((480, 640), 128, np.uint8)
    assert [odometry.step(grey, grey).status for _ in range(3)] == ["starting", "lost", "lost"]

"""A real recording whose images go dark, or out of focus, for a second."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import quaternion_to_matrix, se3_inverse
from sigmaslam.readers import open_sequence
from sigmaslam.readers.inertial import find_imu, read_imu
from sigmaslam.slam.tracker import Estimate, StereoTracker
from tests.support.inertial import SENSOR
from tests.support.simulated_stereo import parallel_camera


def true_poses(path: Path) -> np.ndarray:
    table = np.loadtxt(path)
    T = np.tile(np.eye(4), (len(table), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = quaternion_to_matrix(table[:, 4:]), table[:, 1:4]
    return T


def follow(folder: Path, spoil: Callable[[np.ndarray], np.ndarray], spoilt: range) -> list[Estimate]:
    """Estimates of the frames up to the sixth after those that are spoilt."""
    sequence, recording = open_sequence(folder), read_imu(find_imu(folder))
    tracker = StereoTracker(sequence.camera, threads=1, imu=recording.sensor)
    samples, given, estimates = recording.samples, 0, []
    for k, frame in enumerate(sequence.frames()):
        end = int(np.searchsorted(samples.timestamp, frame.timestamp)) + 1
        for row in range(given, end):
            tracker.add_imu(samples.timestamp[row], samples.gyro[row], samples.accel[row])
        given, images = end, (frame.left, frame.right)
        if k in spoilt:
            images = tuple(np.clip(spoil(each), 0, 255).astype(np.uint8) for each in images)
        estimates.append(tracker.step(*images, frame.timestamp))
        if k > spoilt.stop + 5:
            break
    return estimates


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "start"), [(25.0, 40), (12.0, 50)])
def test_a_defocused_second_costs_no_more_than_a_dark_one(real_data, sigma: float, start: int):
    """What little such images show made keyframes and began anew: 11 sharp frames were not known, then off by 5 cm."""
    folder, rng, spoilt = real_data / "euroc_mh01_f000_099", np.random.default_rng(2), range(start, start + 20)

    def defocus(image):
        return cv2.GaussianBlur(image, (0, 0), sigma) + rng.normal(0.0, 2.0, image.shape)

    estimates, truth = follow(folder, defocus, spoilt), true_poses(folder / "groundtruth.tum")
    assert {each.status for each in estimates[spoilt.stop :]} == {"tracking"}
    assert [each.status for each in estimates].count("inertial") >= 18
    found = se3_inverse(estimates[start - 1].T_world_camera) @ estimates[-1].T_world_camera
    error = (se3_inverse(truth[start - 1]) @ truth[len(estimates) - 1] - found)[:3, 3]
    assert np.linalg.norm(error) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("start", [10, 50])
def test_a_dark_second_loses_no_frame_and_few_centimetres(real_data, start: int):
    folder, rng, dark = real_data / "euroc_mh01_f000_099", np.random.default_rng(7), range(start, start + 20)
    estimates = follow(folder, lambda image: rng.normal(3, 1.5, image.shape), dark)
    statuses = [each.status for each in estimates]
    assert statuses[dark.start : dark.stop] == ["inertial"] * len(dark)
    assert "lost" not in statuses
    assert statuses[dark.stop] in ("tracking", "doubtful")
    truth, before = true_poses(folder / "groundtruth.tum"), dark.start - 1
    for k, most in ((dark.stop - 1, 0.05), (dark.stop, 0.01)):
        found = se3_inverse(estimates[before].T_world_camera) @ estimates[k].T_world_camera
        error = (se3_inverse(truth[before]) @ truth[k] - found)[:3, 3]
        assert np.linalg.norm(error) < most
    sigma = np.sqrt(np.trace(estimates[dark.stop - 1].covariance[:3, :3]))
    assert 0.005 < sigma < 0.1


def test_samples_are_for_trackers_with_a_sensor_and_must_be_numbers():
    camera = parallel_camera(160, 120, 100.0, 0.1)
    with pytest.raises(InputError, match="knows no such sensor"):
        StereoTracker(camera, "orb").add_imu(0.0, np.zeros(3), np.zeros(3))
    tracker = StereoTracker(camera, "orb", imu=SENSOR)
    with pytest.raises(InputError, match="three finite numbers"):
        tracker.add_imu(0.0, np.array([0, 0, np.nan]), np.zeros(3))
    with pytest.raises(InputError, match="three finite numbers"):
        tracker.add_imu(0.0, np.zeros(2), np.zeros(3))
    with pytest.raises(InputError, match="add_odometry: the tracker knows no such sensor: make it with odometry="):
        tracker.add_odometry(0.0, np.zeros(3), np.zeros(3))
    tracker = StereoTracker(camera, "orb", odometry=OdometrySensor(np.eye(4)))
    with pytest.raises(InputError, match="add_odometry: expected seconds"):
        tracker.add_odometry(0.0, np.zeros(3), np.array([0, 0, np.inf]))

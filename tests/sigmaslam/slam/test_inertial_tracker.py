"""A real recording whose images go dark for a second."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import quaternion_to_matrix, se3_inverse
from sigmaslam.readers import open_sequence
from sigmaslam.readers.inertial import find_imu, read_imu
from sigmaslam.slam.tracker import StereoTracker
from tests.support.inertial import SENSOR
from tests.support.simulated_stereo import parallel_camera

DARK = range(50, 70)


def true_poses(path: Path) -> np.ndarray:
    table = np.loadtxt(path)
    T = np.tile(np.eye(4), (len(table), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = quaternion_to_matrix(table[:, 4:]), table[:, 1:4]
    return T


@pytest.mark.slow
def test_a_dark_second_loses_no_frame_and_few_centimetres(real_data):
    folder = real_data / "euroc_mh01_f000_099"
    sequence, recording, rng = open_sequence(folder), read_imu(find_imu(folder)), np.random.default_rng(7)
    tracker = StereoTracker(sequence.camera, threads=1, imu=recording.sensor)
    samples, given, estimates = recording.samples, 0, []
    for k, frame in enumerate(sequence.frames()):
        end = int(np.searchsorted(samples.timestamp, frame.timestamp)) + 1
        for row in range(given, end):
            tracker.add_imu(samples.timestamp[row], samples.gyro[row], samples.accel[row])
        given, images = end, (frame.left, frame.right)
        if k in DARK:
            images = tuple(np.clip(rng.normal(3, 1.5, each.shape), 0, 255).astype(np.uint8) for each in images)
        estimates.append(tracker.step(*images, frame.timestamp))
        if k > DARK.stop + 5:
            break
    statuses = [each.status for each in estimates]
    assert statuses[DARK.start : DARK.stop] == ["inertial"] * len(DARK)
    assert "lost" not in statuses
    assert statuses[DARK.stop] in ("tracking", "doubtful")
    truth, before = true_poses(folder / "groundtruth.tum"), DARK.start - 1
    for k, most in ((DARK.stop - 1, 0.05), (DARK.stop, 0.01)):
        found = se3_inverse(estimates[before].T_world_camera) @ estimates[k].T_world_camera
        error = (se3_inverse(truth[before]) @ truth[k] - found)[:3, 3]
        assert np.linalg.norm(error) < most
    sigma = np.sqrt(np.trace(estimates[DARK.stop - 1].covariance[:3, :3]))
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

"""Dark seconds at 8 m/s of a real drive, with OXTS packets as an inertial sensor or as odometry.

`python -m pytest -m "data or slow" -s tests/sigmaslam/slam/test_dark_drive.py` prints them.
"""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.odometry_sensor import OdometrySamples, OdometrySensor
from sigmaslam.geometry.se3 import se3_body, se3_inverse, se3_log
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.readers.odometry import OdometryRecording
from sigmaslam.readers.open_inertial import open_imu
from sigmaslam.readers.oxts import read_packets
from sigmaslam.runs.request import TrackerOptions
from sigmaslam.runs.track import _build_tracker, _sensors

STARTS, LENGTH = (40, 65, 90, 115, 140, 165), 10
DRIVE = "kitti_raw_0926_0039_a"


def give_sensor(sequence: StereoSequence, folder: Path, sensor: str) -> None:
    """An inertial sensor, or odometry made of the packets: speed and yaw rate, or all six velocities."""
    packets = folder / "oxts_packets.csv"
    imu = open_imu(sequence, str(packets))
    if sensor.startswith("inertial"):
        sequence.imu = imu
    if sensor not in ("none", "inertial"):
        rows = [row.split(",")[-1].split() for row in packets.read_text().splitlines()[1:]]
        linear, angular = np.array([row[8:11] for row in rows], float), read_packets(packets)[1][:, :3]
        is_planar = "speed and yaw rate" in sensor
        if is_planar:
            linear, angular = linear * [1, 0, 0], angular * [0, 0, 1]
        mounting = OdometrySensor(imu.sensor.T_left_imu, is_planar=is_planar)
        samples = OdometrySamples(imu.samples.timestamp, angular, linear)
        sequence.odometry = OdometryRecording(packets, mounting, samples)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensor",
    [
        "none",
        "inertial",
        "speed and yaw rate",
        "all velocities",
        "inertial, speed and yaw rate",
    ],
)
def test_a_dark_second_at_8_metres_a_second(real_data, sensor):
    folder = real_data / DRIVE
    truth = np.tile(np.eye(4), (186, 1, 1))
    truth[:, :3] = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    sequence, rng = open_sequence(folder), np.random.default_rng(7)
    give_sensor(sequence, folder, sensor)
    tracker = _build_tracker(sequence, TrackerOptions(frontend="klt", threads=1), None, ())
    sensors, estimates = _sensors(sequence, tracker), []
    errors, again, nees = [], [], []
    for k, frame in enumerate(sequence.frames()):
        images = frame.left, frame.right
        begun = next((start for start in STARTS if start <= k <= start + LENGTH), None)
        if begun is not None and k < begun + LENGTH:
            images = tuple(np.clip(rng.normal(3, 1.5, each.shape), 0, 255).astype(np.uint8) for each in images)
        for samples in sensors:
            samples.feed(frame.timestamp)
        estimates.append(tracker.step(*images, frame.timestamp))
        if begun is None or k < begun + LENGTH - 1:
            continue
        found = se3_inverse(estimates[begun - 1].T_world_camera) @ estimates[k].T_world_camera
        departure = se3_log(se3_inverse(found) @ se3_inverse(truth[begun - 1]) @ truth[k])
        if k == begun + LENGTH:
            again.append((np.linalg.norm(departure[:3]), estimates[k].status))
            continue
        errors.append(np.r_[np.linalg.norm(departure[:3]), np.degrees(np.linalg.norm(departure[3:]))])
        covariance = se3_body(tracker._motion.step, tracker._motion.step_covariance)
        nees.append(departure @ np.linalg.solve(covariance, departure) / 6)
    lost = [each.status for each in estimates].count("lost")
    worst, median = np.max(errors, axis=0), np.median(errors, axis=0)
    print(
        f"{sensor}: {lost} lost; worst {worst[0]:.2f} m, {worst[1]:.1f} deg; median {median[0]:.2f} m, {median[1]:.1f} "
        f"deg; NEES {np.mean(nees):.1f}; first good image worst {max(again)[0]:.2f} m"
    )
    if sensor != "none":
        assert lost == 0
        assert worst[0] <= 0.3
    elif [status for _, status in again].count("lost") == 1:
        # After the start at 40 too few landmarks are found by chance: in four of eight draws of a focal length 1e-4
        # longer or shorter, in one of eight without the lens of both eyes as a hypothesis; in none of 47 other starts.
        assert lost == len(STARTS) * LENGTH + 1
        pytest.xfail("the first good image after one of six is lost")
    else:
        assert lost == len(STARTS) * LENGTH
    assert all(status in ("tracking", "doubtful", "relocalised") for _, status in again)

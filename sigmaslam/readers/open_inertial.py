"""The inertial sensor of a recording: a table beside it, OXTS packets, or a topic of the bag."""

import logging
from contextlib import closing
from pathlib import Path

import numpy as np

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.progress import open_progress
from sigmaslam.readers.bag import BagReader, open_reader
from sigmaslam.readers.inertial import InertialRecording, describe_lack, find_imu, read_imu, read_sensor, record
from sigmaslam.readers.kitti import find_layout
from sigmaslam.readers.oxts import RT3003_WALKS, estimate_densities, find_kitti_mounting, is_oxts, read_packets
from sigmaslam.readers.ros_messages import IMU, stamp_ns
from sigmaslam.readers.stereo_sequence import StereoSequence

_LOGGER = logging.getLogger(__name__)

# Messages that take about two seconds to read.
_QUICKLY_READ = 20_000


def open_imu(sequence: StereoSequence, given: str | None) -> InertialRecording | None:
    """The inertial sensor beside the images.

    Args:
        given: a table, a folder of EuRoC's or KITTI raw's, a topic of the bag, or "off"; None: the one that the
            recording has, if files say all of it.
    Raises:
        InputError: there is none of that name, or what it measured is wrong.
        CalibrationError: noise or mounting are missing or wrong.
    """
    if given == "off":
        return None
    source = Path(sequence.source)
    if sequence.format == "bag" and (given is None or not Path(given).exists()):
        return _read_topic(source, given)
    path = find_imu(source) if given is None else Path(given)
    if path is None:
        return None
    if path.exists() and is_oxts(path):
        return _read_oxts(path, sequence)
    return read_imu(path)


def _read_oxts(path: Path, sequence: StereoSequence) -> InertialRecording:
    seconds, values = read_packets(path)
    if describe_lack(path) is None:
        return record(path, seconds, values, read_sensor(path))
    layout = find_layout(Path(sequence.source))
    is_rectified = sequence.camera.left.distortion_model == "none"
    T_left_imu = find_kitti_mounting(path, is_rectified, 0 if layout is None else layout[2][0])
    if T_left_imu is None:
        raise CalibrationError(
            f"{path}: nothing says where the sensor is: put KITTI's calib_imu_to_velo.txt, calib_velo_to_cam.txt and "
            "calib_cam_to_cam.txt beside it or above"
        )
    sensor = InertialSensor(T_left_imu, *estimate_densities(seconds, values), *RT3003_WALKS)
    return record(path, seconds, values, sensor)


def _read_topic(path: Path, given: str | None) -> InertialRecording | None:
    # Files of the sensor stand in the bag's folder, or beside the bag where it is a file.
    table = path / path.name if path.is_dir() else path
    with open_reader(path) as bag:
        topics = [topic for topic, (kind, _) in bag.topics.items() if kind == IMU]
        chosen = [topic for topic in topics if given is None or topic.strip("/") == given.strip("/")]
        if given is not None and len(chosen) != 1:
            raise InputError(
                f"{path}: no topic or file {given}; choose with --imu, or --imu off; topics of inertial sensors and "
                f"their number of messages:{bag.list_topics(IMU)}"
            )
        if given is None and not topics:
            return None
        reason = describe_lack(table) if len(chosen) == 1 else "choose one with --imu TOPIC"
        if given is None and reason is not None:
            _LOGGER.warning("%s: %s not used: %s", path, " and ".join(topics), reason)
            return None
        sensor = read_sensor(table)
        seconds, values = _read_messages(bag, chosen[0])
    return record(path, seconds, values, sensor)


def _read_messages(bag: BagReader, topic: str) -> tuple[np.ndarray, np.ndarray]:
    count = bag.topics[topic][1]
    stamps, recorded, values = np.zeros(count), np.zeros(count), np.zeros((count, 6))
    with open_progress(hidden=count < _QUICKLY_READ) as progress, closing(bag.messages([topic])) as messages:
        task = progress.add_task(topic, total=count, note="")
        for k, (_, time, message) in enumerate(messages):
            stamps[k], recorded[k] = stamp_ns(message) / 1_000_000_000, time / 1_000_000_000
            rate, force = message.angular_velocity, message.linear_acceleration
            values[k] = rate.x, rate.y, rate.z, force.x, force.y, force.z
            progress.update(task, completed=k + 1)
    whole = np.isfinite(values).all(axis=1)
    if not whole.all():
        _LOGGER.warning("%s: %d messages have values that are not finite: left out", topic, (~whole).sum())
        stamps, recorded, values = stamps[whole], recorded[whole], values[whole]
    # Drivers without a clock leave the stamps of the headers at zero.
    return recorded if not stamps.any() else stamps, values

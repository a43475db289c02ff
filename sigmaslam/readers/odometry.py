"""Odometry beside the images: CSV of velocities with a YAML of the vehicle's frame."""

import csv
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text, shorten
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.odometry_sensor import OdometrySamples, OdometrySensor
from sigmaslam.readers.inertial import SensorRecording, in_order, parse_stamp, read_rigid

# Names of columns, in the order of time, linear and angular velocity; the first name is the one in messages.
_NAMES = (("timestamp", "time", "t"), ("vx", "speed"), ("vy",), ("vz",), ("wx",), ("wy",), ("wz", "yaw_rate"))
_TIME, _FORWARD, _ROLL, _PITCH, _YAW = 0, 1, 4, 5, 6


OdometryRecording = SensorRecording[OdometrySensor, OdometrySamples]


def read_odometry(path: Path) -> OdometryRecording:
    """A table with a head: timestamp, speed (or vx), yaw_rate (or wz), and vy, vz, wx, wy where they are measured.

    m/s and rad/s in the vehicle's axes forward, left, up; what has no column is zero. T_cam_base and, where the clocks
    differ, timeshift_cam_base stand in a YAML of the table's name.

    Raises:
        InputError: the table is missing or lacks a column, a field is no number, or time runs backwards.
        CalibrationError: the YAML is missing or wrong.
    """
    rows = list(csv.reader(read_text(path, TABLE_BYTES, "the odometry").splitlines()))
    # As in EuRoC's tables a unit may stand behind a name, and a # before the first one.
    head = [each.strip(" #").split(" ")[0].lower() for each in (rows[0] if rows else [])]
    columns = [next((head.index(name) for name in names if name in head), None) for names in _NAMES]
    lacking = [" or ".join(_NAMES[k]) for k in (_TIME, _FORWARD, _YAW) if columns[k] is None]
    if lacking:
        raise InputError(
            f"{path}: line 1: no column {', '.join(lacking)} in {shorten(','.join(head))}: give a head with timestamp, "
            "speed (m/s) and yaw_rate (rad/s), or timestamp, vx, vy, vz, wx, wy, wz"
        )
    table = np.zeros((len(rows) - 1, len(_NAMES)))
    for number, row in enumerate(rows[1:], start=2):
        try:
            table[number - 2] = [
                0.0 if column is None else (parse_stamp if k == _TIME else float)(row[column])
                for k, column in enumerate(columns)
            ]
        except (ValueError, IndexError):
            table[number - 2] = np.nan
        if not np.isfinite(table[number - 2]).all():
            raise InputError(f"{path}: line {number}: expected numbers under {','.join(head)}, found {','.join(row)}")
    later = in_order(path, table[:, _TIME])
    kept = table[later]
    samples = OdometrySamples(kept[:, _TIME], kept[:, 4:], kept[:, 1:4])
    is_planar = columns[_ROLL] is None or columns[_PITCH] is None
    return OdometryRecording(path, _read_sensor(path, is_planar), samples, int((~later).sum()))


def _read_sensor(table: Path, is_planar: bool) -> OdometrySensor:
    path = table.with_suffix(".yaml")
    if not path.is_file():
        raise CalibrationError(
            f"{table}: nothing says where the vehicle's frame is: put {path.name} beside it, with T_cam_base, (4, 4), "
            "which takes points of the vehicle (forward, left, up) into the left camera"
        )
    content = CalibrationYaml.read(path)
    return OdometrySensor(read_rigid(content, "T_cam_base"), content.number("timeshift_cam_base", 0.0), is_planar)

"""poses.csv of a run: time, status, pose and covariance of each frame with a pose, in one table."""

import csv
from pathlib import Path

import numpy as np

from sigmaslam.files import atomic_path
from sigmaslam.geometry.se3 import matrix_to_quaternion
from sigmaslam.run_record.frame_table import FrameTable
from sigmaslam.run_record.pose_file import PoseRecords

POSES_NAME = "poses.csv"
_ERRORS = ("x", "y", "z", "rx", "ry", "rz")
_UPPER = np.triu_indices(6)
COLUMNS = (
    *("timestamp", "status", "x", "y", "z", "qx", "qy", "qz", "qw"),
    *(f"cov_{_ERRORS[row]}_{_ERRORS[column]}" for row, column in zip(*_UPPER, strict=True)),
)
"""Seconds, status, position in metres, rotation, and the upper triangle of the covariance (6, 6) of the pose in its own
frame, translation in metres before rotation in radians."""


def write_pose_table(path: Path, records: PoseRecords, frames: FrameTable) -> None:
    """Writes poses as they were said, with the status of their frames.

    Args:
        path: of the table.
        records: the poses.
        frames: of the run, in order of time.
    """
    # frames.csv has nanoseconds.
    rows = np.searchsorted(frames.columns["timestamp"], records.timestamp - 5e-7)
    quaternions = matrix_to_quaternion(records.pose[:, :3, :3])
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for k, row in enumerate(rows):
            numbers = (*records.pose[k, :3, 3], *quaternions[k], *records.covariance[k][_UPPER])
            table.writerow(
                [f"{records.timestamp[k]:.9f}", frames.status[row], *(f"{number:.9g}" for number in numbers)]
            )

"""What was said of each frame with a pose: poses.partial as it comes, poses.csv in the end."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.files import atomic_path, atomic_write_bytes
from sigmaslam.geometry.se3 import matrix_to_quaternion
from sigmaslam.run_record.appended_file import pack_rows, read_rows
from sigmaslam.run_record.frame_table import FrameTable
from sigmaslam.table import Table

PARTIAL_POSES = "poses.partial"
POSES_NAME = "poses.csv"
_ERRORS = ("x", "y", "z", "rx", "ry", "rz")
_UPPER = np.triu_indices(6)
COLUMNS = (
    *("timestamp", "status", "x", "y", "z", "qx", "qy", "qz", "qw"),
    *(f"cov_{_ERRORS[row]}_{_ERRORS[column]}" for row, column in zip(*_UPPER, strict=True)),
)
"""Seconds, status, position in metres, rotation, and the upper triangle of the covariance (6, 6) of the pose in its own
frame, translation in metres before rotation in radians."""


@dataclass(frozen=True, slots=True)
class PoseRecords(Table):
    """Frames with a pose.

    Attributes:
        timestamp: (N,) seconds.
        pose: (N, 4, 4) of what is tracked: the camera in the world, or a body in the camera.
        covariance: (N, 6, 6) of the pose in its own frame, translation (metres) before rotation (radians).
        matching: (N, 6, 6) the part of the covariance that comes from matches and motion.
    """

    timestamp: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    matching: np.ndarray


def pack_pose(timestamp: float, pose: np.ndarray, covariance: np.ndarray, matching: np.ndarray) -> bytes:
    """A row of `PoseRecords` as `PARTIAL_POSES` has it."""
    return pack_rows(np.array([timestamp]), pose[None], covariance[None], matching[None])


def read_pose_records(folder: Path) -> PoseRecords:
    """The poses that a run has left in its folder so far."""
    return PoseRecords(*read_rows(folder / PARTIAL_POSES, (), (4, 4), (6, 6), (6, 6)))


def write_pose_records(folder: Path, records: PoseRecords) -> None:
    """Writes poses as a run leaves them, so that it can go on."""
    atomic_write_bytes(folder / PARTIAL_POSES, pack_rows(*records.columns()))


def write_pose_table(path: Path, records: PoseRecords, frames: FrameTable) -> None:
    """Writes poses as they were said, with the status of their frames, which are in the order of time."""
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

"""poses.partial of a run: what was said of each frame with a pose, on disk as it came; gone when the run is written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.files import atomic_path
from sigmaslam.run_record.appended_file import AppendedFile, read_records
from sigmaslam.table import Table

PARTIAL_POSES = "poses.partial"
# Numbers of a row on disk: time stamp, pose, two covariances.
_WIDTH = 1 + 16 + 36 + 36


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


class PoseWriter:
    """Appends poses to the file in the folder of a run, a new one or one that goes on."""

    def __init__(self, folder: Path, goes_on: bool = False) -> None:
        self._file = AppendedFile(folder / PARTIAL_POSES, goes_on)

    def add(self, timestamp: float, pose: np.ndarray, covariance: np.ndarray, matching: np.ndarray) -> None:
        """Takes a row of `PoseRecords`; it is on disk when this returns."""
        row = np.r_[timestamp, pose.ravel(), covariance.ravel(), matching.ravel()]
        self._file.append(row.astype(np.float64).tobytes())

    def close(self) -> None:
        """The last pose has come."""
        self._file.close()


def read_pose_records(folder: Path) -> PoseRecords:
    """The poses that a run has left in its folder so far."""
    rows = read_records(folder / PARTIAL_POSES, _WIDTH)
    return PoseRecords(
        rows[:, 0],
        rows[:, 1:17].reshape(-1, 4, 4),
        rows[:, 17:53].reshape(-1, 6, 6),
        rows[:, 53:89].reshape(-1, 6, 6),
    )


def write_pose_records(folder: Path, records: PoseRecords) -> None:
    """Writes poses as a run leaves them, so that it can go on."""
    count = len(records)
    columns = (records.timestamp, records.pose, records.covariance, records.matching)
    rows = np.column_stack([column.reshape(count, -1) for column in columns])
    with atomic_path(folder / PARTIAL_POSES) as temporary:
        temporary.write_bytes(rows.astype(np.float64).tobytes())

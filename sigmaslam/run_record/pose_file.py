"""poses.partial of a run: what was said of each frame with a pose, on disk as it came; gone when the run is written."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.files import atomic_write_bytes
from sigmaslam.run_record.appended_file import AppendedFile, pack_rows, read_rows
from sigmaslam.table import Table

PARTIAL_POSES = "poses.partial"


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


class PoseWriter(AppendedFile):
    """Appends poses to the file in the folder of a run, a new one or one that goes on."""

    def __init__(self, folder: Path, goes_on: bool = False) -> None:
        super().__init__(folder / PARTIAL_POSES, goes_on)

    def add(self, timestamp: float, pose: np.ndarray, covariance: np.ndarray, matching: np.ndarray) -> None:
        """Takes a row of `PoseRecords`; it is on disk when this returns."""
        self.append(pack_rows(np.array([timestamp]), pose[None], covariance[None], matching[None]))


def read_pose_records(folder: Path) -> PoseRecords:
    """The poses that a run has left in its folder so far."""
    return PoseRecords(*read_rows(folder / PARTIAL_POSES, (), (4, 4), (6, 6), (6, 6)))


def write_pose_records(folder: Path, records: PoseRecords) -> None:
    """Writes poses as a run leaves them, so that it can go on."""
    atomic_write_bytes(folder / PARTIAL_POSES, pack_rows(*records.columns()))

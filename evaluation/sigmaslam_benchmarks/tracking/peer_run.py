"""The run folder of a tracker that is not ours: poses, and a table of the frames with their times."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.files import make_folder
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.frame_table import COLUMNS


@dataclass(frozen=True, slots=True)
class PeerStep:
    """Result for one stereo pair.

    Attributes:
        T_world_camera: (4, 4) pose of the left camera as calibrated; None where there is none.
        status: as in frames.csv.
        matches, inliers: points, where they are known.
    """

    T_world_camera: np.ndarray | None
    status: str
    matches: int = 0
    inliers: int = 0


def write_peer_run(sequence: StereoSequence, out: Path, step: Callable[[StereoFrame], PeerStep]) -> None:
    """Tracks a sequence; leaves trajectory.tum, of the frames with a pose, and frames.csv in the new folder `out`."""
    make_folder(out)
    timestamps: list[float] = []
    poses: list[np.ndarray] = []
    with (out / "frames.csv").open("w", newline="", encoding="utf-8") as table:
        rows = csv.DictWriter(table, ["status", *COLUMNS, "ms_step"])
        rows.writeheader()
        for frame in sequence.frames():
            began = time.perf_counter()
            found = step(frame)
            row = {"status": found.status, "timestamp": frame.timestamp, "matches": found.matches}
            rows.writerow(row | {"inliers": found.inliers, "ms_step": 1e3 * (time.perf_counter() - began)})
            if found.T_world_camera is not None:
                timestamps.append(frame.timestamp)
                poses.append(found.T_world_camera)
    write_tum(out / "trajectory.tum", Trajectory(np.array(timestamps), np.stack(poses)))

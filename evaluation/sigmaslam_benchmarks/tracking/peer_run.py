"""The run folder of a tracker that is not ours: poses, and a table of the frames with their times."""

import csv
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from sigmaslam.files import make_folder
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoSequence
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.frame_table import COLUMNS


@dataclass(frozen=True, slots=True)
class PeerStep:
    """Result for one stereo pair.

    Attributes:
        T_world_camera: (4, 4) pose of the left camera as calibrated; None where there is none.
        status: as in frames.csv.
        matches, inliers: points, where they are known.
        covariance: (6, 6) in the camera's own frame, translation (metres) before rotation (radians); None where
            the peer says none.
    """

    T_world_camera: np.ndarray | None
    status: str
    matches: int = 0
    inliers: int = 0
    covariance: np.ndarray | None = None


class Peer(Protocol):
    """Tracks stereo pairs, one after another.

    Attributes:
        version: of its package, if it has one.
    """

    version: str

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
        """The pose of a pair (H, W) uint8; time stamps are seconds."""

    def close(self) -> None:
        """Ends what it has begun."""


def write_peer_run(sequence: StereoSequence, out: Path, peer: Peer, live: bool = False) -> None:
    """Tracks a sequence into the new folder `out`: trajectory.tum of the frames with a pose, and frames.csv.

    Where each of these poses has a covariance, covariance.npy has them.

    Args:
        sequence: opened by `open_sequence`.
        out: run folder.
        peer: tracks the pairs.
        live: frames come no sooner than their time stamps say, as from a camera.
    """
    make_folder(out)
    timestamps: list[float] = []
    poses: list[np.ndarray] = []
    covariances: list[np.ndarray] = []
    ahead: float | None = None  # of the time stamps before the clock, seconds
    with (out / "frames.csv").open("w", newline="", encoding="utf-8") as table:
        rows = csv.DictWriter(table, ["status", *COLUMNS, "ms_step"])
        rows.writeheader()
        for frame in sequence.frames():
            if live:
                ahead = frame.timestamp - time.perf_counter() if ahead is None else ahead
                time.sleep(max(0.0, frame.timestamp - ahead - time.perf_counter()))
            began = time.perf_counter()
            found = peer.step(frame.left, frame.right, frame.timestamp)
            status = "starting" if found.status == "tracking" and not poses else found.status
            row = {"status": status, "timestamp": frame.timestamp, "matches": found.matches}
            rows.writerow(row | {"inliers": found.inliers, "ms_step": 1e3 * (time.perf_counter() - began)})
            if found.T_world_camera is not None:
                timestamps.append(frame.timestamp)
                poses.append(found.T_world_camera)
                if found.covariance is not None:
                    covariances.append(found.covariance)
    write_tum(out / "trajectory.tum", Trajectory(np.array(timestamps), np.stack(poses)))
    if covariances and len(covariances) == len(poses):
        np.save(out / "covariance.npy", np.stack(covariances))

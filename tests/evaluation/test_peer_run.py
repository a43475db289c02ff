"""Peers that take rectified pairs, given raw ones: poses and covariances are of the left camera as calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam_benchmarks.tracking import stereo_peers
from sigmaslam_benchmarks.tracking.peer_run import PeerStep
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer

LOST = 2
"""Number of the frame without a pose."""


class StandIn:
    """Says known poses and covariances."""

    version = "stand-in 1"

    def __init__(self, camera: object) -> None:
        self.count, self.is_closed = -1, False

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> PeerStep:
        self.count += 1
        return PeerStep(None, "lost") if self.count == LOST else known_step(self.count)

    def close(self) -> None:
        self.is_closed = True


def pose(number: int) -> np.ndarray:
    return se3_exp(number * np.array([0.1, -0.02, 0.3, 0.01, 0.03, -0.02]))


def known_step(number: int) -> PeerStep:
    return PeerStep(pose(number), "tracking", covariance=number * np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))


def test_poses_are_of_the_left_camera_as_calibrated(
    demo_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    peers: list[StandIn] = []
    monkeypatch.setattr(stereo_peers, "CuvslamPeer", lambda camera: peers.append(StandIn(camera)) or peers[-1])
    sequence = open_sequence(demo_sequence)
    turned = sequence.camera.T_left_right @ se3_exp(np.array([0.0, 0.004, 0.002, 0.01, 0.02, -0.01]))
    sequence.camera = replace(sequence.camera, T_left_right=turned)
    R = StereoRectifier(sequence.camera).R_rectified_left
    assert np.abs(R - np.eye(3)).max() > 1e-3
    track_with_peer(sequence, tmp_path / "run", "cuvslam")

    T_rectified_left = np.eye(4)
    T_rectified_left[:3, :3] = R
    count = peers[0].count + 1
    expected = [T_rectified_left.T @ pose(k) @ T_rectified_left for k in range(count) if k != LOST]
    np.testing.assert_allclose(read_tum(tmp_path / "run" / "trajectory.tum").poses, expected, rtol=0, atol=1e-9)
    assert read_frames(tmp_path / "run" / "frames.csv").status == [
        "starting",
        "tracking",
        "lost",
        *["tracking"] * (count - 3),
    ]
    both = np.kron(np.eye(2), R.T)  # turns translation and rotation
    turned_covariances = [both @ known_step(k).covariance @ both.T for k in range(count) if k != LOST]
    np.testing.assert_allclose(np.load(tmp_path / "run" / "covariance.npy"), turned_covariances, rtol=0, atol=1e-12)
    assert peers[0].is_closed

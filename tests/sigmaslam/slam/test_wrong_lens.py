"""A lens that is wrong in both eyes alike."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam import StereoTracker, open_sequence
from sigmaslam_benchmarks.live.calibration_faults import bend_both


@pytest.mark.long
def test_a_lens_that_is_wrong_in_both_eyes_is_named_and_corrected(demo_sequence: Path):
    """The render's end was 91 mm off, and a yaw was named, before lenses of both eyes were a hypothesis."""
    k1, sequence = 0.05, open_sequence(demo_sequence)
    tracker = StereoTracker(bend_both(k1, sequence.camera), threads=1)
    estimates = [tracker.step(frame.left, frame.right, frame.timestamp) for frame in sequence.frames()]
    ((name, (probability, mean, sigma)),) = estimates[-1].calibration.causes.items()
    assert name == "lens"
    assert probability > 0.99
    assert abs(mean + k1) < 3.0 * sigma < 0.3 * k1
    first, last = np.loadtxt(demo_sequence / "poses.txt").reshape(-1, 3, 4)[[0, -1]]
    true = first[:, :3].T @ (last[:, 3] - first[:, 3])
    assert np.linalg.norm(estimates[-1].T_world_camera[:3, 3] - true) < 0.04
    assert estimates[-1].status == "doubtful"

"""The example that runs the graphs without the package finds the pose of a frame, and knows how well."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from tests.support.examples import load_example

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
@pytest.mark.parametrize("index", [3, 6])
def test_the_pose_is_within_its_covariance_of_the_truth(index):
    example = load_example("run_one_frame")
    folder = ROOT / "synthetic" / "sigmaslam_synthetic" / "demo"
    pose, covariance = example.run(ROOT / "models" / "sigmaslam_weights", folder, index)
    truth = np.vstack([np.loadtxt(folder / "poses.txt")[index].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    error = truth @ np.linalg.inv(pose)
    twist = np.array([*error[:3, 3], error[2, 1], error[0, 2], error[1, 0]])  # from the left
    assert twist @ np.linalg.solve(covariance, twist) < chi2.ppf(0.999, 6)
    assert np.linalg.norm(twist[:3]) < 0.1 * np.linalg.norm(truth[:3, 3])

"""A three-cornered hat: parts of sources whose noise is known, and what they share."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.files import save_arrays
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.relative_pose_file import FramePairs
from sigmaslam_benchmarks.tracking.three_cornered_hat import format_hat, own_parts

SIGMAS = {"truth": 0.3, "ours": 0.02, "cuvslam": 0.05, "klt-pnp": 0.1}


def drawn(count: int, shared: float = 0.0) -> dict[str, np.ndarray]:
    """Relative poses by source, whose errors are alike in all directions; all but the truth share some."""
    rng = np.random.default_rng(0)
    true = se3_exp(np.array([0.5, 0.2, 10.0, 0.02, 0.1, 0.0]))
    common = shared * rng.standard_normal((count, 6))
    return {
        name: true @ se3_exp(0.1 * (sigma * rng.standard_normal((count, 6)) + (common if name != "truth" else 0.0)))
        for name, sigma in SIGMAS.items()
    }


def test_each_source_s_own_noise_is_found():
    parts, differences = own_parts(drawn(20_000))
    for name, sigma in SIGMAS.items():
        np.testing.assert_allclose(parts[name], 0.1 * sigma, atol=2e-3)
    both = 0.1 * np.hypot(SIGMAS["truth"], SIGMAS["ours"])
    np.testing.assert_allclose(differences["truth", "ours"], both, rtol=0.03)


def test_what_three_of_four_share_counts_as_the_fourth_s():
    parts, _ = own_parts(drawn(20_000, shared=0.4))
    np.testing.assert_allclose(parts["truth"], 0.1 * np.hypot(0.3, 0.4), rtol=0.05)
    assert parts["ours"].max() < 0.005


def test_the_table_has_a_row_for_each_source_and_what_ours_says(tmp_path: Path):
    """Heights of the truth err by 0.05 m, the trackers not at all; frames that one of them lacks do not count."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, 2, 3] = np.arange(400.0)
    exact, measured = Trajectory(0.1 * np.arange(400), poses), poses.copy()
    measured[:, 1, 3] += 0.05 * rng.standard_normal(400)
    for name in ("ours", "cuvslam", "klt-pnp"):
        (tmp_path / name).mkdir()
        write_tum(tmp_path / name / "trajectory.tum", exact if name != "klt-pnp" else exact.subset(np.arange(5, 400)))
    earlier = np.arange(300)
    relative = se3_inverse(poses[earlier]) @ poses[earlier + 100]
    said = np.tile(0.25 * np.eye(6), (300, 1, 1))
    pairs = FramePairs(np.full(300, "100 m"), earlier, earlier + 100, relative, said)
    save_arrays(tmp_path / "ours" / "relative_poses.npz", **pairs.arrays())
    rows = [line.split(" | ") for line in format_hat(tmp_path, Trajectory(exact.timestamps, measured)).splitlines()]
    of_100_m = {row[1]: row[2:] for row in rows if "100 m, 295 pairs" in row[0]}
    assert float(of_100_m["truth, own part"][1]) == pytest.approx(0.05 * np.sqrt(2.0), rel=0.1)
    assert float(of_100_m["ours, own part"][1]) < 0.01
    assert float(of_100_m["ours, sigma it says"][0]) == 0.5
    assert "ours, sigma it says" not in {row[1] for row in rows if "10 m," in row[0]}

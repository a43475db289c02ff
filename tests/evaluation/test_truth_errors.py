"""The kind of a truth, poses of it that nobody measured, and the sentence about a NEES far from 1."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_exp, se3_adjoint, se3_exp, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_trajectory, write_kitti, write_tum
from sigmaslam_evaluation.metrics.relative_consistency import SpanConsistency
from sigmaslam_evaluation.metrics.trajectory_errors import PoseNees
from sigmaslam_evaluation.nees_verdict import judge_nees
from sigmaslam_evaluation.run_evaluation import evaluate_run
from sigmaslam_evaluation.truth_errors import guess_truth_kind, leave_out_interpolated, truth_errors
from tests.support.commands import run_here

TIMES = 0.1 * np.arange(80)


def drive(turn: float = 0.01, shake: float = 3e-4) -> Trajectory:
    """A vehicle that drives a bend and whose turn, a frame, changes by hundredths of a degree."""
    rng = np.random.default_rng(0)
    poses = [np.eye(4)]
    for _ in TIMES[1:]:
        poses.append(poses[-1] @ se3_exp(np.array([0, 0, 0.8, 0, turn, 0]) + shake * rng.standard_normal(6)))
    return Trajectory(TIMES, np.array(poses))


def filled_in(truth: Trajectory, first: int, last: int, bend: float = 0.0) -> Trajectory:
    """The truth with its poses between two frames interpolated; the first of them turned by so much before."""
    poses = truth.poses.copy()
    poses[first] = poses[first] @ se3_exp(np.array([0, 0, 0, 0, bend, 0]))
    motion = se3_log(se3_inverse(poses[first]) @ poses[last])
    for k in range(first + 1, last):
        poses[k] = poses[first] @ se3_exp(motion * (k - first) / (last - first))
    return Trajectory(truth.timestamps, poses)


def test_the_interpolated_stretch_is_left_out_and_its_ends_stay():
    true = drive()
    assert leave_out_interpolated(true, true) == (true, None)
    kept, words = leave_out_interpolated(true, filled_in(true, 30, 45))
    np.testing.assert_array_equal(kept.timestamps, np.delete(TIMES, np.arange(31, 45)))
    assert words is not None
    assert "has 14 poses from 3.100 to 4.400 s that are left out" in words
    # At the beginning of a file nothing says that the first of them was measured.
    np.testing.assert_array_equal(leave_out_interpolated(true, filled_in(true, 0, 13))[0].timestamps, TIMES[13:])


def test_a_truth_at_a_higher_rate_loses_the_poses_between_frames_too():
    every = filled_in(drive(), 20, 40)
    estimate = every.subset(np.arange(0, 80, 2))
    kept, words = leave_out_interpolated(estimate, every)
    np.testing.assert_array_equal(kept.timestamps, np.delete(TIMES, np.arange(21, 40)))
    assert words is not None
    assert "has 9 poses" in words


@pytest.mark.parametrize(
    "motion", [np.zeros(6), np.array([0.001, 0, 0, 0, 0, 0]), np.array([0, 0, 0.8, 0, 0.01, 0])], ids=str
)
def test_what_stands_slides_on_a_stage_or_is_made_to_turn_alike_stays(motion: np.ndarray):
    made = Trajectory(TIMES, se3_exp(np.arange(80)[:, None] * motion))
    assert leave_out_interpolated(made, made) == (made, None)


@pytest.mark.data
def test_kittis_interpolated_frames_are_found_and_no_others(real_data: Path):
    found = {}
    for path in [
        real_data / "kitti00_stereo_features_gtsam/kitti_00_gt_first77.txt",
        *sorted((real_data / "kitti_gt_trajectories").glob("*.txt")),
        real_data / "kitti_raw_0926_0039_a/poses.txt",
        real_data / "kitti_odometry_01_f000_050/poses.txt",
        real_data / "euroc_mh01_f000_099/groundtruth.tum",
    ]:
        truth = read_trajectory(path)
        words = leave_out_interpolated(truth, truth)[1]
        if words:
            found[path.name] = words.split(" s that")[0]
    assert found == {
        "kitti_00_gt_first77.txt": "has 13 poses from 0.000 to 1.200",
        "05.txt": "has 13 poses from 150.000 to 151.200",
    }


def test_the_kind_follows_from_the_file_and_its_neighbours(tmp_path: Path):
    hall, road = drive(0.3), drive(0.0)
    write_tum(tmp_path / "gt.tum", hall)
    write_kitti(tmp_path / "poses.txt", road)
    assert guess_truth_kind(tmp_path / "gt.tum", hall)[0] == "mocap"
    assert guess_truth_kind(tmp_path / "gt.tum", road)[0] == "gps"
    assert guess_truth_kind(tmp_path / "poses.txt", road) == ("gps", "its format is KITTI's")
    (tmp_path / "scene.json").write_text("{}")
    assert guess_truth_kind(tmp_path / "poses.txt", road)[0] == "exact"


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, Path]:
    """A run with an honest covariance, and a truth that was filled in at the start, off by 0.6 degrees."""
    true, rng = drive(), np.random.default_rng(1)
    sigma = np.array([2e-3, 2e-3, 2e-3, 1e-4, 1e-4, 1e-4])
    poses, covariance = [true.poses[0]], [np.zeros((6, 6))]
    for motion in se3_inverse(true.poses[:-1]) @ true.poses[1:]:
        adjoint = se3_adjoint(se3_inverse(motion))
        poses.append(poses[-1] @ motion @ se3_exp(sigma * rng.standard_normal(6)))
        covariance.append(adjoint @ covariance[-1] @ adjoint.T + np.diag(sigma**2))
    folder = tmp_path / "run"
    folder.mkdir()
    write_tum(folder / "trajectory.tum", Trajectory(TIMES, np.array(poses)))
    np.save(folder / "covariance.npy", np.array(covariance))
    write_tum(tmp_path / "truth.tum", filled_in(true, 0, 13, bend=0.01))
    return folder, tmp_path / "truth.tum"


def test_frames_before_the_truth_was_measured_do_not_spoil_the_nees(run: tuple[Path, Path]):
    sigmas = {"truth_sigma_position": 1e-4, "truth_sigma_rotation": 1e-3}
    exact, measured = evaluate_run(*run, plot=False), evaluate_run(*run, plot=False, **sigmas)
    assert exact.nees is not None
    assert measured.nees is not None
    assert (exact.matched, measured.matched) == (80, 67)
    assert exact.nees.mean > 10.0
    assert 0.2 < measured.nees.mean < 2.0


@pytest.mark.long
def test_the_command_says_what_it_takes_the_truth_for(run: tuple[Path, Path]):
    folder, truth = run
    guessed = run_here("evaluate", folder, "--truth", truth)
    assert guessed.returncode == 0, guessed.stderr
    assert "The truth is taken for GPS/INS, sigma 0.2 m and 0.1 deg, as its poses extend over" in guessed.stdout
    assert "The truth has 13 poses from 0.000 to 1.200 s that are left out" in guessed.stdout
    content = json.loads((folder / "evaluation.json").read_text())
    assert len(content["truth_notes"]) == 2
    told = run_here("evaluate", folder, "--truth", truth, "--truth-kind", "exact").stdout
    assert "The truth" not in told
    assert "the estimate's sigma is too small if the truth is exact, as is said" in told


def span(name: str, nees: float, error: float, share: float = 0.2, median: float | None = None) -> SpanConsistency:
    values = np.full(12, nees if median is None else median)
    values[0] = 12 * nees - values[1:].sum()
    return SpanConsistency(name, values, nees, 0.1, 0.5, error, error, 0.1, 0.1, share)


def nees(mean: float, with_truth: bool = True) -> PoseNees:
    return PoseNees(mean, mean, mean, mean, TIMES[:1], np.array([mean]), with_truth)


def test_a_nees_near_one_is_not_worth_a_word():
    assert judge_nees(None, None) is None
    assert judge_nees(nees(2.9), (span("1 s", 0.4, 0.1),)) is None
    # A span that shows nothing but the truth's errors is said to do so already.
    assert judge_nees(nees(1.0), (span("1 s", 0.01, 0.1, share=0.99),)) is None
    # Nine pairs are too few.
    assert judge_nees(None, (replace(span("1 s", 99.0, 0.1), nees=np.full(9, 99.0)),)) is None


@pytest.mark.parametrize(
    ("spans", "with_truth", "kind", "words"),
    [
        ((span("1 s", 5, 0.1), span("20 s", 16, 1.5)), True, "warn", "over 20 s is 16, errors are 4 times"),
        (
            (span("1 s", 5, 0.1), span("20 s", 16, 1.5)),
            True,
            "warn",
            "the estimate's sigma is too small, as errors grow",
        ),
        ((span("1 s", 16, 0.1), span("20 s", 9, 0.12)), True, "warn", "the truth's sigma is too small"),
        ((span("1 s", 16, 0.1),), True, "warn", "or the truth's is too small, the run is too short"),
        ((span("1 s", 16, 0.1), span("20 s", 9, 0.12)), False, "warn", "if the truth is exact"),
        ((span("1 s", 9, 0.1, median=0.5),), True, "warn", "a few frames are far off"),
        ((span("1 s", 0.1, 0.1),), True, "note", "the estimate's sigma is too large, which is cautious"),
    ],
)
def test_a_nees_far_from_one_gets_one_sentence(
    spans: tuple[SpanConsistency, ...], with_truth: bool, kind: str, words: str
):
    verdict = judge_nees(nees(1.0, with_truth), spans)
    assert verdict is not None
    assert verdict["kind"] == kind
    assert words in verdict["text"]
    assert verdict["text"].count(". ") == 0


def test_heights_of_gps_are_worse_and_its_errors_change_slowly(tmp_path: Path):
    """A camera that looks along the world's x, with y down as in KITTI: what is vertical is its y all the way."""
    poses = np.tile(np.eye(4), (201, 1, 1))
    poses[:, :3, :3] = rotation_exp(np.array([0.0, np.pi / 2, 0.0]))
    truth, path = Trajectory(0.1 * np.arange(201), poses), tmp_path / "poses.txt"
    write_kitti(path, truth)
    errors, said = truth_errors(path, truth, "gps", (None, 0.0))
    assert errors is not None
    assert said is None
    # After 1 s INS has gone off by 0.03 m at most; after ten both ends err by themselves, by 0.2 m each.
    for frames, expected in ((10, 0.03), (200, 0.2 * np.sqrt(2.0))):
        (found,) = errors.between(truth, np.array([0]), np.array([frames]))
        np.testing.assert_allclose(np.sqrt(np.diag(found)), [expected, 2 * expected, expected, 0, 0, 0], atol=1e-9)
    stated, _ = truth_errors(path, truth, "gps", (0.5, 0.1))
    assert stated is not None
    (found,) = stated.between(truth, np.array([0]), np.array([1]))
    np.testing.assert_allclose(np.sqrt(np.diag(found))[:3], 0.5 * np.sqrt(2.0))
    assert truth_errors(path, truth, "exact", (None, None)) == (None, None)
    assert truth_errors(path, truth, None, (0.0, 0.0)) == (None, None)

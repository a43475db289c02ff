"""Relative poses against the truth: known answers, the truth's own errors by Monte Carlo, and the run folder."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.files import save_arrays
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.appended_file import AppendedFile
from sigmaslam.run_record.relative_pose_file import (
    PARTIAL_RELATIVE_POSES,
    FramePairs,
    collect_frame_pairs,
    pack_relative_poses,
    read_frame_pairs,
)
from sigmaslam.slam.relative_poses import SPANS, RelativePoses
from sigmaslam_evaluation.evaluation_summary import format_evaluation
from sigmaslam_evaluation.metrics.relative_consistency import relative_consistency
from sigmaslam_evaluation.metrics.truth_covariance import TruthErrors, relative_truth_covariance, truth_covariance
from sigmaslam_evaluation.run_evaluation import evaluate_run
from tests.support.commands import run_here

COUNT = 400
STEP = np.array([0.02, 0.0, 1.0, 0.0, 0.01, 0.0])
SIGMA = np.array([0.01, 0.01, 0.02, 5e-4, 5e-4, 5e-4])


def winding_path(count: int = COUNT) -> Trajectory:
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3_exp(STEP))
    return Trajectory(0.1 * np.arange(count), np.array(poses))


def pairs_of(truth: Trajectory, gaps: dict[str, int], claimed: float = 1.0, seed: int = 0) -> FramePairs:
    """Frames so many apart, with errors of `SIGMA` in the later one's frame, and what is claimed of them."""
    rng = np.random.default_rng(seed)
    spans, earlier, later = [], [], []
    for span, gap in gaps.items():
        later += list(range(gap, len(truth)))
        earlier += list(range(len(truth) - gap))
        spans += [span] * (len(truth) - gap)
    true = se3_inverse(truth.poses[earlier]) @ truth.poses[later]
    pose = true @ se3_exp(SIGMA * rng.standard_normal((len(true), 6)))
    covariance = np.tile(claimed * np.diag(SIGMA**2), (len(true), 1, 1))
    return FramePairs(np.array(spans), np.array(earlier), np.array(later), pose, covariance)


def test_right_covariances_have_a_nees_of_one_and_95_percent_inside():
    truth = winding_path()
    pairs = pairs_of(truth, {"10 m": 10, "1 s": 10, "5 s": 50})
    spans = relative_consistency(pairs, truth, truth)
    assert [span.span for span in spans] == ["10 m", "1 s", "5 s"]
    for span in spans:
        # Of 350 independent pairs the mean scatters by 0.03, the share by 0.012.
        assert span.mean_nees == pytest.approx(1.0, abs=0.1)
        assert span.median_nees == pytest.approx(0.89, abs=0.1)
        assert span.inside == pytest.approx(0.95, abs=0.035)
        assert span.translation_nees == pytest.approx(1.0, abs=0.15)
        assert span.rotation_nees == pytest.approx(1.0, abs=0.15)
        assert span.translation_sigma == pytest.approx(np.sqrt((SIGMA[:3] ** 2).sum()))
        assert span.translation_rmse == pytest.approx(span.translation_sigma, rel=0.1)
        assert span.rotation_rmse_deg == pytest.approx(span.rotation_sigma_deg, rel=0.1)
        assert math.isnan(span.truth_share)
        assert not span.truth_rules
    assert [span.count for span in spans] == [390, 390, 350]


def test_a_covariance_a_hundred_times_too_small_has_a_nees_of_a_hundred():
    truth = winding_path()
    (span,) = relative_consistency(pairs_of(truth, {"10 m": 10}, claimed=0.01), truth, truth)
    assert span.mean_nees == pytest.approx(100.0, rel=0.1)
    assert span.inside == 0.0


def test_where_the_world_lies_does_not_matter():
    """Nor does an error of the first pose, which all later ones share."""
    truth = winding_path()
    pairs = pairs_of(truth, {"1 s": 10})
    moved = Trajectory(truth.timestamps, se3_exp(np.array([5.0, -3.0, 1.0, 0.3, 1.0, -0.2])) @ truth.poses)
    (one,), (other,) = relative_consistency(pairs, truth, truth), relative_consistency(pairs, truth, moved)
    np.testing.assert_allclose(one.nees, other.nees, rtol=1e-6)


def test_frames_without_truth_are_left_out():
    truth = winding_path()
    pairs = pairs_of(truth, {"1 s": 10})
    kept = np.r_[0:100, 130:COUNT]
    (span,) = relative_consistency(pairs, truth, truth.subset(kept))
    assert span.count == 390 - 40  # later ends 100 to 129, and earlier ones
    (all_of_them,) = relative_consistency(pairs, truth, truth)
    later = pairs.later
    known = np.isin(later, kept) & np.isin(later - 10, kept)
    np.testing.assert_allclose(span.nees, all_of_them.nees[known], rtol=1e-9)


@pytest.mark.parametrize(("position", "rotation_deg"), [(0.05, 0.0), (0.0, 0.3), (0.05, 0.3)])
def test_the_truth_s_covariance_is_that_of_its_drawn_errors(position: float, rotation_deg: float):
    """The rotation of the earlier end acts on the way between the two: 20 m with 0.3 degrees are 0.1 m."""
    rng = np.random.default_rng(0)
    earlier = se3_exp(np.array([3.0, 1.0, -2.0, 0.4, -0.8, 0.2]))
    relative = se3_exp(np.array([1.0, 2.0, 20.0, 0.1, 0.5, -0.2]))
    draws = 40_000

    def drawn(pose: np.ndarray) -> np.ndarray:
        """Positions in the world and rotations in the body are off."""
        noisy = np.tile(pose, (draws, 1, 1))
        turns = np.zeros((draws, 6))
        turns[:, 3:] = math.radians(rotation_deg) * rng.standard_normal((draws, 3))
        noisy[:, :3, :3] = pose[:3, :3] @ se3_exp(turns)[:, :3, :3]
        noisy[:, :3, 3] += position * rng.standard_normal((draws, 3))
        return noisy

    found = se3_inverse(drawn(earlier)) @ drawn(earlier @ relative)
    errors = se3_log(se3_inverse(relative) @ found)
    own = truth_covariance(position, rotation_deg)[None]
    expected = relative_truth_covariance(relative[None], own, own)[0]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    used = scale > 0
    difference = np.abs(errors.T @ errors / draws - expected)
    assert (difference[used] / scale[used]).max() < 0.03
    assert difference[~used].max(initial=0.0) < 1e-12


def test_a_noisy_truth_counts_by_its_sigmas():
    exact = winding_path()
    rng = np.random.default_rng(1)
    position, rotation_deg = 0.1, 0.2
    scale = np.repeat([position, math.radians(rotation_deg)], 3)
    noisy = Trajectory(exact.timestamps, exact.poses @ se3_exp(scale * rng.standard_normal((COUNT, 6))))
    pairs = pairs_of(exact, {"1 m": 1, "10 m": 10})
    of_truth = TruthErrors(truth_covariance(position, rotation_deg))
    for as_exact, judged in zip(
        relative_consistency(pairs, exact, noisy), relative_consistency(pairs, exact, noisy, of_truth), strict=True
    ):
        assert as_exact.mean_nees > 20
        assert judged.mean_nees == pytest.approx(1.0, abs=0.12)
        assert judged.inside == pytest.approx(0.95, abs=0.035)
        assert judged.truth_rules


def test_half_of_the_covariance_is_where_the_truth_begins_to_rule():
    """Of errors that are no larger than both say: here none."""
    truth = winding_path()
    pairs = pairs_of(truth, {"10 m": 10})
    pairs = replace(pairs, pose=se3_inverse(truth.poses[pairs.earlier]) @ truth.poses[pairs.later])
    own = np.tile(np.diag(SIGMA**2), (COUNT, 1, 1))
    for factor, rules in ((0.9, False), (1.1, True)):
        of_truth = factor * own
        relative = se3_inverse(truth.poses[pairs.earlier]) @ truth.poses[pairs.later]
        whole = relative_truth_covariance(relative, of_truth[pairs.earlier], of_truth[pairs.later])
        pairs = replace(pairs, covariance=whole / factor)
        (span,) = relative_consistency(pairs, truth, truth, TruthErrors(of_truth))
        assert span.truth_share == pytest.approx(factor / (1.0 + factor), rel=1e-6)
        assert span.truth_rules == rules


def test_an_estimate_that_is_too_sure_does_not_make_the_truth_rule():
    """Errors of ten sigmas of the truth are the estimate's, whatever it claims."""
    truth = winding_path()
    of_truth = TruthErrors(0.01 * np.diag(SIGMA**2))
    (span,) = relative_consistency(pairs_of(truth, {"1 m": 1}, claimed=1e-4), truth, truth, of_truth)
    assert span.truth_share > 0.9
    assert span.mean_nees > 10
    assert not span.truth_rules


# ---- the file, and the run folder


def some_rows(timestamps: np.ndarray, spans: list[int], seed: int) -> RelativePoses:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(len(spans), 6, 6))
    return RelativePoses(
        np.array(spans), timestamps, se3_exp(rng.normal(size=(len(spans), 6))), root @ root.transpose(0, 2, 1)
    )


def test_the_file_round_trips(tmp_path: Path):
    times = 1.5e9 + np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 20))
    writer = AppendedFile(tmp_path / PARTIAL_RELATIVE_POSES)
    rows = {5: some_rows(times[[0, 3]], [4, 0], 1), 6: RelativePoses.empty(), 19: some_rows(times[[17]], [6], 2)}
    for frame in range(20):
        writer.append(pack_relative_poses(frame, rows.get(frame, RelativePoses.empty())))
    writer.close()
    save_arrays(tmp_path / "relative_poses.npz", **collect_frame_pairs(tmp_path, times).arrays())
    pairs = read_frame_pairs(tmp_path / "relative_poses.npz", 20)
    assert pairs.span.tolist() == [SPANS[4], SPANS[0], SPANS[6]]
    assert (pairs.earlier.tolist(), pairs.later.tolist()) == ([0, 3, 17], [5, 5, 19])
    np.testing.assert_array_equal(pairs.pose, np.concatenate([rows[5].pose, rows[19].pose]))
    np.testing.assert_array_equal(pairs.covariance, np.concatenate([rows[5].covariance, rows[19].covariance]))


def test_files_of_other_runs_and_other_files_are_refused(tmp_path: Path):
    path = tmp_path / "relative_poses.npz"
    save_arrays(path, **pairs_of(winding_path(30), {"1 s": 10}).arrays())
    with pytest.raises(InputError, match=r"relative_poses\.npz: has frame 29, but .* 20 poses"):
        read_frame_pairs(path, 20)
    np.savez(path, span=np.zeros(3))
    with pytest.raises(InputError, match=r"relative_poses\.npz: misses earlier, later, pose, covariance; run"):
        read_frame_pairs(path, 20)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"relative_poses\.npz: is no numpy archive"):
        read_frame_pairs(path, 20)


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, Path]:
    """A run folder with relative poses, and its truth."""
    truth = winding_path()
    (tmp_path / "run").mkdir()
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "run" / "trajectory.tum", truth)
    save_arrays(tmp_path / "run" / "relative_poses.npz", **pairs_of(truth, {"10 m": 10, "5 s": 50}).arrays())
    return tmp_path / "run", tmp_path / "truth.tum"


@pytest.mark.long
def test_table_dictionary_and_figure_show_relative_poses(run: tuple[Path, Path]):
    evaluation = evaluate_run(*run)
    assert evaluation.relative is not None
    ten_metres = evaluation.relative[0]
    content = json.loads(json.dumps(evaluation.to_dict(), allow_nan=False))["relative"]
    assert [each["span"] for each in content] == ["10 m", "5 s"]
    assert content[0]["mean_nees"] == ten_metres.mean_nees
    assert (content[0]["count"], content[0]["truth_share"]) == (390, None)
    lines = format_evaluation(evaluation).splitlines()
    row = next(line for line in lines if "over 10 m" in line)
    assert f"{ten_metres.mean_nees:.2f}" in row
    assert f"{100 * ten_metres.inside:.0f} %" in row
    assert max(map(len, lines[2:])) <= 160
    assert evaluation.figure_path is not None
    assert evaluation.figure_path.stat().st_size > 10_000


@pytest.mark.long
def test_options_of_the_command_line_are_the_truth_s_sigmas(run: tuple[Path, Path]):
    folder, truth = run
    arguments = ("evaluate", folder, "--truth", truth)
    plain = run_here(*arguments, "--truth-kind", "exact")
    assert plain.returncode == 0, plain.stderr
    assert "no better than" not in plain.stdout
    told = run_here(*arguments, "--truth-sigma-position", "0.5", "--truth-sigma-rotation", "0.5")
    assert told.stdout.count("the truth is no better than the estimate here") == 2
    assert (
        "no better than"
        not in run_here(*arguments, "--truth-sigma-position", "0.0001", "--truth-sigma-rotation", "0").stdout
    )
    assert run_here(*arguments, "--truth-sigma-position", "-1").returncode == 2


def test_trajectories_of_others_have_no_relative_figures(run: tuple[Path, Path]):
    folder, truth = run
    evaluation = evaluate_run(folder / "trajectory.tum", truth, plot=False)
    assert evaluation.relative is None
    assert evaluation.to_dict()["relative"] is None
    assert "Relative poses: -" in format_evaluation(evaluation)


def test_a_followed_body_is_judged_in_its_own_frame(tmp_path: Path):
    """The truth is of another frame on the body, in the camera; its sigmas are of that."""
    rng = np.random.default_rng(3)
    camera = winding_path(200)  # in the body's frame
    body = se3_inverse(camera.poses)
    on_body = se3_exp(np.array([0.1, 0.2, -0.1, 0.5, 0.1, 0.0]))
    sigma = np.repeat([0.02, math.radians(0.1)], 3)
    truth = Trajectory(camera.timestamps, body @ on_body @ se3_exp(sigma * rng.standard_normal((200, 6))))
    run = tmp_path / "run"
    run.mkdir()
    write_tum(run / "trajectory.tum", Trajectory(camera.timestamps, body))
    (run / "run.json").write_text(json.dumps({"object": {}}))
    save_arrays(run / "relative_poses.npz", **pairs_of(camera, {"1 s": 10}).arrays())
    write_tum(tmp_path / "truth.tum", truth)
    relative = evaluate_run(
        run, tmp_path / "truth.tum", plot=False, truth_sigma_position=0.02, truth_sigma_rotation=0.1
    ).relative
    assert relative is not None
    assert relative[0].mean_nees == pytest.approx(1.0, abs=0.2)

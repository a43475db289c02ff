import errno
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_kitti, read_trajectory, read_tum, write_kitti, write_tum
from sigmaslam.run_record.evaluated_frames import read_evaluated_frames
from sigmaslam_evaluation.evaluation_summary import format_evaluation
from sigmaslam_evaluation.run_evaluation import evaluate_run
from tests.support.commands import run_here


def make_run(folder: Path, truth: Trajectory, seed: int = 0) -> None:
    """A run folder with a drifting estimate of the truth and the covariance of that drift."""
    generator = np.random.default_rng(seed)
    sigma = np.array([0.01, 0.01, 0.015, 4e-4, 4e-4, 4e-4])
    motions = se3_inverse(truth.poses[:-1]) @ truth.poses[1:]
    poses, covariance = [np.eye(4)], [np.zeros((6, 6))]
    for motion in motions:
        adjoint = se3_adjoint(se3_inverse(motion))
        poses.append(poses[-1] @ motion @ se3_exp(sigma * generator.normal(size=6)))
        covariance.append(adjoint @ covariance[-1] @ adjoint.T + np.diag(sigma**2))
    write_tum(folder / "trajectory.tum", Trajectory(truth.timestamps, np.array(poses)))
    np.save(folder / "covariance.npy", np.array(covariance))


@pytest.fixture
def drive(real_data: Path, tmp_path) -> tuple[Path, Path]:
    """A run folder over real KITTI motion, and the truth with its times."""
    source = real_data / "kitti_raw_0926_0039_a"
    (tmp_path / "run").mkdir()
    make_run(tmp_path / "run", read_trajectory(source / "poses.txt"))
    return tmp_path / "run", source / "poses.txt"


@pytest.mark.long
def test_run_folder_gives_every_number(drive):
    run, truth = drive
    evaluation = evaluate_run(run, truth)
    assert (evaluation.matched, evaluation.frames, evaluation.association) == (186, 186, "time")
    assert evaluation.path_length == pytest.approx(154, abs=1)
    assert 0 < evaluation.ate.rmse <= evaluation.ate_origin.rmse
    assert evaluation.kitti.lengths.tolist() == [100.0]
    assert evaluation.nees is not None
    assert len(evaluation.nees.per_frame) == 185
    assert 0.3 < evaluation.nees.mean < 3
    assert evaluation.figure_path == run / "evaluation.png"
    assert evaluation.figure_path.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in run.iterdir()) == [
        "covariance.npy",
        "evaluation.json",
        "evaluation.npz",
        "evaluation.png",
        "trajectory.tum",
    ]
    kept = read_evaluated_frames(run / "evaluation.npz", 186)
    assert kept.row.tolist() == list(range(186))
    assert np.nanmean(kept.nees) == pytest.approx(evaluation.nees.mean)
    # In the world of the estimate the truth is as far from it as in its own.
    distance = np.linalg.norm(read_tum(run / "trajectory.tum").positions - kept.truth, axis=1)
    assert np.sqrt(np.mean(distance**2)) == pytest.approx(evaluation.ate.rmse)
    assert json.loads((run / "evaluation.json").read_text()) == evaluation.to_dict()


def test_dictionary_is_json_and_table_shows_the_same(drive):
    evaluation = evaluate_run(*drive, lengths=(20, 50), plot=False)
    content = json.loads(json.dumps(evaluation.to_dict(), allow_nan=False))
    assert content["ate"]["rmse"] == evaluation.ate.rmse
    assert content["nees"]["count"] == 185
    assert content["kitti"]["lengths"] == [20, 50]
    assert content["coverage"] == 1.0
    table = format_evaluation(evaluation)
    assert f"{evaluation.ate.rmse:.4f}" in table
    assert f"{evaluation.kitti.mean_translation_percent:.3f}" in table
    assert f"overconfident): {evaluation.nees.mean:.2f}" in table
    assert max(map(len, table.splitlines()[2:])) <= 160


def test_a_trajectory_after_the_fact_is_evaluated_beside(drive):
    run, truth = drive
    without = evaluate_run(run, truth, plot=False)
    assert without.final is None
    assert without.to_dict()["final"] is None
    assert "After the fact" not in format_evaluation(without)
    live, true = read_trajectory(run / "trajectory.tum"), read_trajectory(truth)
    write_tum(run / "trajectory_final.tum", Trajectory(live.timestamps, true.poses))
    evaluation = evaluate_run(run, truth, plot=False)
    assert evaluation.ate.rmse == without.ate.rmse
    assert evaluation.final is not None
    assert evaluation.final.ate.rmse == pytest.approx(0, abs=1e-6)
    assert evaluation.final.nees is None
    np.save(run / "covariance_final.npy", np.tile(1e-4 * np.eye(6), (186, 1, 1)))
    evaluation = evaluate_run(run, truth, plot=False)
    content = json.loads(json.dumps(evaluation.to_dict(), allow_nan=False))["final"]
    assert content["nees"]["count"] == 185
    assert content["nees"]["mean"] == pytest.approx(0, abs=1e-3)
    assert set(content) == {"ate", "ate_origin", "rpe", "nees"}
    table = format_evaluation(evaluation)
    assert f"{without.ate.rmse:.4f}" in table.partition("After the fact")[0]
    assert "0.0000" in table.partition("After the fact")[2]


def test_another_run_as_the_truth_judges_no_sigma(drive, tmp_path: Path):
    run, truth = drive
    (tmp_path / "again").mkdir()
    make_run(tmp_path / "again", read_trajectory(truth))
    np.save(tmp_path / "again" / "covariance.npy", 100 * np.load(run / "covariance.npy"))
    write_tum(run / "trajectory.tum", read_trajectory(truth))
    before = evaluate_run(tmp_path / "again", run / "trajectory.tum", plot=False)
    assert before.nees_verdict is not None
    assert "sigma is too large" in before.nees_verdict["text"]
    (run / "run.json").write_text("{}")
    after = evaluate_run(tmp_path / "again", run / "trajectory.tum", plot=False)
    assert after.nees_verdict is None
    assert "The truth is another run: of the same images both share errors" in format_evaluation(after)
    assert "too large" not in format_evaluation(after)
    (run / "trajectory.tum").rename(run / "groundtruth.tum")  # a truth that someone put beside the run
    assert evaluate_run(tmp_path / "again", run / "groundtruth.tum", plot=False).nees_verdict == before.nees_verdict


def test_a_trajectory_after_the_fact_of_another_run_is_refused(drive):
    run, truth = drive
    write_tum(run / "trajectory_final.tum", read_trajectory(run / "trajectory.tum").subset(np.arange(20)))
    with pytest.raises(InputError, match=r"trajectory_final.tum: has 20 poses, .* 186: both must"):
        evaluate_run(run, truth, plot=False)


def test_missing_frames_lower_the_coverage(drive):
    run, truth = drive
    full = read_trajectory(run / "trajectory.tum")
    kept = np.setdiff1d(np.arange(186), np.arange(60, 90))
    write_tum(run / "trajectory.tum", full.subset(kept))
    np.save(run / "covariance.npy", np.load(run / "covariance.npy")[kept])
    assert evaluate_run(run, truth, plot=False).coverage == pytest.approx(156 / 186, abs=0.01)
    header = "timestamp,status,matches,inliers,nis,dof,belief,disparity_offset,disparity_offset_sigma"
    rows = [f"{time:.9f},{'lost' if 10 <= k < 13 else 'tracking'},,,,,,," for k, time in enumerate(full.timestamps)]
    (run / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    evaluation = evaluate_run(run, truth, plot=False)
    assert (evaluation.matched, evaluation.frames, evaluation.predicted) == (156, 186, 3)
    assert "156 of the 186 with a truth have an estimate (83.9 %), 3 of them while lost" in format_evaluation(
        evaluation
    )


def test_a_path_of_centimetres_is_told_in_millimetres(drive, tmp_path):
    run, truth = drive
    for source, out in ((run / "trajectory.tum", "estimate.tum"), (truth, "truth.tum")):
        whole = read_trajectory(source)
        small = whole.poses.copy()
        small[:, :3, 3] *= 5e-4
        write_tum(tmp_path / out, Trajectory(whole.timestamps, small))
    evaluation = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.tum", plot=False)
    table = format_evaluation(evaluation)
    assert f"{1e3 * evaluation.path_length:.2f} mm true" in table
    assert f"{1e3 * evaluation.ate.rmse:.4f}" in table
    assert "rmse [mm]" in table


def test_times_that_rarely_meet_are_told(drive):
    run, truth = drive
    assert "clock" not in format_evaluation(evaluate_run(run, truth, plot=False))
    estimate = read_trajectory(run / "trajectory.tum")
    regular = Trajectory(0.1 * np.arange(len(estimate)), estimate.poses)  # the drive has 0.1034 s from frame to frame
    write_tum(run / "trajectory.tum", regular)
    evaluation = evaluate_run(run, truth, plot=False)
    assert evaluation.matched < 80
    words = f"The truth meets {evaluation.matched} of 178 poses within 0.02 s: are both in the clock of the images?"
    assert words in format_evaluation(evaluation)
    write_tum(run / "trajectory.tum", regular.subset(np.arange(0, 6)))  # these meet
    (run / "covariance.npy").unlink()
    assert "clock" not in format_evaluation(evaluate_run(run, truth, plot=False))


def test_a_picture_that_cannot_be_written_costs_a_warning_alone(drive, monkeypatch, caplog):
    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("sigmaslam.files.atomic_path", full)
    evaluation = evaluate_run(*drive)
    assert evaluation.figure_path is None
    assert evaluation.matched == 186
    assert "evaluation.png is not written: No space left on device" in caplog.text
    told = run_here("evaluate", drive[0], "--truth", drive[1])
    assert told.returncode == 0
    assert "No picture" not in told.stderr


@pytest.mark.long
def test_kitti_truth_without_times_is_paired_by_index_when_counts_agree(real_data: Path, tmp_path):
    truth = read_kitti(real_data / "kitti_gt_trajectories" / "04.txt")
    write_kitti(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "estimate.tum", Trajectory(1.4e9 + 0.1036 * np.arange(len(truth)), truth.poses))
    evaluation = evaluate_run(tmp_path / "estimate.tum", tmp_path / "truth.txt")
    assert (evaluation.association, evaluation.matched) == ("index", 271)
    assert evaluation.ate.rmse == pytest.approx(0, abs=1e-6)
    assert evaluation.nees is None
    assert (tmp_path / "evaluation.png").is_file()


def test_kitti_truth_without_times_never_pairs_wrong_frames(real_data: Path, tmp_path):
    truth = read_kitti(real_data / "kitti_gt_trajectories" / "04.txt")
    write_kitti(tmp_path / "truth.txt", truth)
    kept = np.arange(0, 260)
    write_tum(tmp_path / "at_10_hz.tum", truth.subset(kept))
    evaluation = evaluate_run(tmp_path / "at_10_hz.tum", tmp_path / "truth.txt", plot=False)
    assert (evaluation.association, evaluation.matched, evaluation.frames) == ("time at 10 Hz", 260, 271)
    write_tum(tmp_path / "drifting.tum", Trajectory(0.1036 * kept, truth.poses[kept]))
    with pytest.raises(InputError, match=r"truth\.txt.*times\.txt"):
        evaluate_run(tmp_path / "drifting.tum", tmp_path / "truth.txt", plot=False)


@pytest.mark.long
def test_euroc_truth_at_its_own_rate(real_data: Path, tmp_path):
    truth_path = real_data / "euroc_v1_01_keyframes_a" / "groundtruth.csv"
    write_tum(tmp_path / "estimate.tum", read_trajectory(truth_path))
    evaluation = evaluate_run(tmp_path / "estimate.tum", truth_path)
    assert (evaluation.matched, evaluation.frames) == (60, 60)
    assert evaluation.ate.rmse == pytest.approx(0, abs=1e-9)


def test_standing_still_has_no_segments(real_data: Path, tmp_path):
    truth_path = real_data / "euroc_v1_01_static" / "groundtruth.csv"
    write_tum(tmp_path / "estimate.tum", read_trajectory(truth_path))
    evaluation = evaluate_run(tmp_path / "estimate.tum", truth_path)
    assert evaluation.to_dict()["kitti"]["mean_translation_percent"] is None
    assert "none, the path is shorter" in format_evaluation(evaluation)


def test_folder_without_trajectory_is_named(tmp_path):
    with pytest.raises(InputError, match=r"holds no trajectory\.tum"):
        evaluate_run(tmp_path, tmp_path / "truth.txt")


def test_covariance_of_another_run_is_refused(drive):
    run, truth = drive
    np.save(run / "covariance.npy", np.zeros((5, 6, 6)))
    with pytest.raises(InputError, match=r"covariance\.npy.*\(5, 6, 6\).*186"):
        evaluate_run(run, truth)
    (run / "covariance.npy").write_text("no array")
    with pytest.raises(InputError, match=r"covariance\.npy: is no numpy array"):
        evaluate_run(run, truth)


def test_clocks_that_do_not_meet_stop_the_evaluation(drive, tmp_path):
    run, truth = drive
    shutil.copy(truth, tmp_path / "poses.txt")
    (tmp_path / "times.txt").write_text("".join(f"{1e6 + 0.1 * k:.3f}\n" for k in range(186)))
    with pytest.raises(InputError, match="no timestamps"):
        evaluate_run(run, tmp_path / "poses.txt")

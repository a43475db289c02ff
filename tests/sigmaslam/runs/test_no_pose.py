"""Frames before the start have no pose, anywhere in the folder of a run, and every reader of it copes."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from sigmaslam.bundle_adjustment.track_file import read_tracks
from sigmaslam.checks.finding import Finding
from sigmaslam.errors import InputError
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_kitti, read_tum, write_kitti
from sigmaslam.run_record.frame_table import STATUSES, TRACKED, predicted_poses, read_frames
from sigmaslam.run_record.relative_pose_file import read_frame_pairs
from sigmaslam.run_record.verdict import explain_failure
from sigmaslam_benchmarks.trial import read_trial
from sigmaslam_evaluation.evaluation_figure import plot_trajectory
from sigmaslam_evaluation.evaluation_summary import format_evaluation
from sigmaslam_evaluation.run_evaluation import evaluate_run
from tests.support.demo_parts import copy_frames
from tests.support.tracked import track

FRAMES, DARK = 12, 4


def dark_at_first(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (0 * left, 0 * right) if k < DARK else (left, right)


@pytest.fixture(scope="module")
def late(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A sequence whose light comes on late, and its run."""
    source = copy_frames(demo_sequence, tmp_path_factory.mktemp("late") / "sequence", FRAMES, dark_at_first, 4.0)
    track(source, source.with_name("run"), "klt", tracks=True)
    return source, source.with_name("run")


def test_files_of_a_run_are_aligned_from_the_first_pose_on(late: tuple[Path, Path]):
    source, run = late
    trajectory = read_tum(run / "trajectory.tum")
    times = np.loadtxt(source / "times.txt")
    np.testing.assert_allclose(trajectory.timestamps, times[DARK:FRAMES], atol=1e-9)
    np.testing.assert_allclose(np.loadtxt(run / "times.txt"), trajectory.timestamps)
    np.testing.assert_allclose(read_kitti(run / "trajectory.kitti").poses, trajectory.poses, atol=1e-9)
    final = read_tum(run / "trajectory_final.tum")
    np.testing.assert_array_equal(final.timestamps, trajectory.timestamps)
    for name in ("covariance", "covariance_matching", "covariance_final"):
        assert np.load(run / f"{name}.npy").shape == (FRAMES - DARK, 6, 6)
    pairs = read_frame_pairs(run / "relative_poses.npz", len(trajectory))
    assert read_tracks(run / "tracks.npz", len(trajectory)).frame[0] == 0
    assert len(pairs)
    # What is said of a pair of frames is what the trajectory has between them, but for what was learned since.
    for earlier, later, pose in zip(pairs.earlier, pairs.later, pairs.pose, strict=True):
        between = np.linalg.inv(trajectory.poses[earlier]) @ trajectory.poses[later]
        np.testing.assert_allclose(pose[:3, 3], between[:3, 3], atol=0.01)


def test_the_table_of_poses_says_what_the_other_files_say(late: tuple[Path, Path]):
    run = late[1]
    with (run / "poses.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    columns = {name: [row[k] for row in rows] for k, name in enumerate(head)}
    trajectory = read_tum(run / "trajectory.tum")
    np.testing.assert_allclose(np.array(columns["timestamp"], float), trajectory.timestamps, atol=1e-6)
    assert columns["status"] == read_frames(run / "frames.csv").status[DARK:]
    positions = np.column_stack([np.array(columns[axis], float) for axis in "xyz"])
    np.testing.assert_allclose(positions, trajectory.positions, atol=1e-8)
    covariance, names = np.load(run / "covariance.npy"), ("x", "y", "z", "rx", "ry", "rz")
    for i, j in zip(*np.triu_indices(6), strict=True):
        written = np.array(columns[f"cov_{names[i]}_{names[j]}"], float)
        np.testing.assert_allclose(written, covariance[:, i, j], rtol=1e-7)


def test_map_points_have_the_grey_values_of_their_images(late: tuple[Path, Path]):
    with np.load(late[1] / "map.npz") as content:
        pixels, intensity, timestamps = (content[name] for name in ("pixels", "intensity", "timestamps"))
    sequence = open_sequence(late[0])
    rectify = StereoRectifier(sequence.camera).rectify
    images = {frame.timestamp: rectify(frame.left, frame.right)[0] for frame in sequence.frames()}
    assert len(pixels)
    for (u, v), grey, timestamp in zip(np.rint(pixels).astype(int), intensity, timestamps.tolist(), strict=True):
        assert images[timestamp][v, u] == grey


def test_frames_before_the_start_have_a_row_without_belief(late: tuple[Path, Path]):
    frames = read_frames(late[1] / "frames.csv")
    assert frames.status == ["starting"] * (DARK + 1) + ["tracking"] * (FRAMES - DARK - 1)
    np.testing.assert_array_equal(frames.columns["belief"][: DARK + 1], [0.0] * DARK + [1.0])
    for name in ("matches", "inliers", "nis", "dof"):
        assert np.isnan(frames.columns[name][:DARK]).all()
        assert np.isfinite(frames.columns[name][DARK:]).all()


def test_the_summary_says_in_which_frame_the_world_begins(late: tuple[Path, Path]):
    summary = json.loads((late[1] / "run.json").read_text())["summary"]
    assert (summary["frames"], summary["poses"], summary["starting"]) == (FRAMES, FRAMES - DARK, DARK + 1)
    assert summary["first_frame_with_pose"] == DARK
    assert summary["world"] == f"the left camera of frame {DARK} (from 0 on), where tracking started"
    assert summary["failure"] is None


@pytest.mark.parametrize("timed", [True, False])
def test_evaluation_counts_frames_with_an_estimate(late: tuple[Path, Path], tmp_path: Path, timed: bool):
    source, run = late
    truth = source / "poses.txt"
    if not timed:  # paired by index: with all frames, not with all poses
        truth = tmp_path / "poses.txt"
        shutil.copy(source / "poses.txt", truth)
    evaluation = evaluate_run(run, truth, plot=False)
    assert evaluation.association == ("time" if timed else "index")
    assert (evaluation.matched, evaluation.frames, evaluation.predicted) == (FRAMES - DARK, FRAMES, 0)
    assert evaluation.ate_origin.maximum < 0.01
    assert f"{FRAMES - DARK} of the {FRAMES} with a truth have an estimate (66.7 %)" in format_evaluation(evaluation)


def test_frames_without_a_truth_do_not_count(late: tuple[Path, Path], tmp_path: Path):
    source, run = late
    write_kitti(tmp_path / "poses.txt", read_kitti(source / "poses.txt").subset(np.arange(8)), tmp_path / "times.txt")
    evaluation = evaluate_run(run, tmp_path / "poses.txt", plot=False)
    assert (evaluation.matched, evaluation.frames) == (8 - DARK, 8)


def test_a_trial_of_a_late_start_has_statuses_of_its_poses(late: tuple[Path, Path]):
    trial = read_trial(late[1], None)
    assert trial.tracked.tolist() == [False] * (DARK + 1) + [True] * (FRAMES - DARK - 1)
    assert trial.tracked_poses.tolist() == trial.tracked.tolist()[DARK:]


@pytest.mark.parametrize("fault", ["swapped", "black", "one frame"])
def test_a_run_that_tracked_nothing_has_no_pose_and_says_why(demo_sequence: Path, tmp_path: Path, fault: str):
    changes = {"swapped": lambda k, left, right: (right, left), "black": lambda k, left, right: (0 * left, 0 * right)}
    source = copy_frames(demo_sequence, tmp_path / "sequence", 1 if fault == "one frame" else 3, changes.get(fault))
    run = tmp_path / "run"
    summary = track(source, run, "klt")
    assert summary["tracking"] == summary["poses"] == summary["map_points"] == 0
    assert summary["first_frame_with_pose"] is summary["world"] is None
    assert ("single frame" if fault == "one frame" else "never started") in summary["failure"]
    assert sorted(path.name for path in run.iterdir()) == ["frames.csv", "pictures.npz", "report.html", "run.json"]
    assert '<body class="bad">' in (run / "report.html").read_text()
    with pytest.raises(InputError, match=r"run: holds no trajectory\.tum: none of its frames has a pose"):
        evaluate_run(run, source / "poses.txt")


def test_a_place_that_is_not_in_the_map_is_said_to_be_there_not(late: tuple[Path, Path], tmp_path: Path):
    source, run = late
    mirrored = copy_frames(
        source, tmp_path / "sequence", 7, lambda k, left, right: (np.fliplr(right).copy(), np.fliplr(left).copy())
    )
    summary = track(mirrored, tmp_path / "run", "klt", map=run / "map.npz")
    assert summary["poses"] == 0
    assert "not found in the map" in summary["failure"]


def summary_of(**counts: int) -> dict[str, int]:
    summary = {name: counts.get(name, 0) for name in STATUSES}
    summary["tracked"] = sum(summary[name] for name in TRACKED)
    return {**summary, "frames": sum(counts.values())}


@pytest.mark.parametrize(
    ("counts", "in_map", "started", "words"),
    [
        ({"starting": 1, "tracking": 1}, False, True, None),
        ({"starting": 4, "tracking": 3, "relocalised": 1}, False, True, None),
        ({"starting": 2, "tracking": 3, "lost": 2}, False, True, "of 7, 2 are lost, 2 were before"),
        ({"starting": 1, "tracking": 2, "ambiguous": 4}, False, True, "with one answer: of 7, 4 are ambiguous"),
        ({"starting": 1, "ambiguous": 6}, False, True, "of 7, 6 are ambiguous, 0 are lost"),
        ({"skipped": 3}, False, False, "None of the 3 frames could be read"),
        ({}, False, False, "There was no frame"),
        ({"starting": 1}, False, True, "single frame"),
        ({"starting": 5}, False, True, "no later frame was recognised"),
        ({"starting": 5}, False, False, "never started"),
        ({"starting": 5}, True, False, "not found in the map"),
    ],
)
def test_a_failure_is_explained_by_the_statuses(counts: dict, in_map: bool, started: bool, words: str | None):
    explanation = explain_failure(summary_of(**counts), in_map, started, ())
    assert (explanation is None) == (words is None)
    assert words is None or words in (explanation or "")


def test_what_a_check_found_explains_a_failure():
    findings = [
        Finding("eyes", "error", "left and right are exchanged: swap them"),
        Finding("rows", "ok", "rows agree"),
    ]
    nothing = explain_failure(summary_of(starting=8), False, False, findings)
    assert nothing == "Nothing was tracked: left and right are exchanged: swap them"
    little = explain_failure(summary_of(tracking=2, lost=6), False, True, findings)
    assert little is not None
    assert "6 are lost" in little
    assert little.endswith("left and right are exchanged: swap them")
    assert explain_failure(summary_of(tracking=8), False, True, findings) is None
    several = [
        Finding("exposure", "warning", "images are dark"),
        Finding("overlap", "error", "few matches: is it the calibration of these images?"),
        Finding("rows", "error", "rows are off"),
    ]
    both = explain_failure(summary_of(starting=8), False, False, several)
    assert both == (
        "Nothing was tracked: images are dark; few matches: is it the calibration of these images? rows are off"
    )


def test_poses_are_guesses_where_the_camera_is_lost_or_has_not_moved_yet(tmp_path: Path):
    statuses = ["starting", "starting", "starting", "tracking", "lost", "skipped", "lost", "relocalised"]
    header = "timestamp,status,matches,inliers,nis,dof,belief,disparity_offset,disparity_offset_sigma"
    rows = [f"{1.5e9 + 0.1 * k:.9f},{status},,,,,,," for k, status in enumerate(statuses)]
    (tmp_path / "frames.csv").write_text("\n".join([header, *rows]) + "\n")
    with_pose = [1, 2, 3, 4, 6, 7]
    predicted = predicted_poses(read_frames(tmp_path / "frames.csv"), 1.5e9 + 0.1 * np.array(with_pose))
    assert predicted.tolist() == [False, True, False, True, True, False]


def test_a_path_is_solid_where_it_was_seen_and_dashed_where_it_was_not():
    positions = np.column_stack([np.arange(6.0), np.zeros(6), np.arange(6.0) ** 2])
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = positions
    lost = np.array([False, False, True, True, False, False])
    axes = Figure().add_subplot()
    plot_trajectory(axes, {"estimate": Trajectory(np.arange(6.0), poses)}, predicted={"estimate": lost})
    lines = {line.get_linestyle(): np.asarray(line.get_xydata()) for line in axes.lines if len(line.get_xydata()) > 1}
    drawn = {style: set(np.flatnonzero(np.isfinite(path[:-1] + path[1:]).all(axis=1))) for style, path in lines.items()}
    # Segments: the ways to a lost frame and from it are not seen either.
    assert drawn == {"-": {0, 4}, "--": {1, 2, 3}}


def test_an_eye_that_becomes_dark_is_named_when_the_run_has_ended(demo_sequence: Path, tmp_path: Path):
    def darken(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return left, right // 3 if k >= 4 else right

    track(copy_frames(demo_sequence, tmp_path / "dark", 8, darken), tmp_path / "run", "klt")
    (found,) = json.loads((tmp_path / "run" / "run.json").read_text())["checks"]
    assert found["figure"] == pytest.approx(3.0, abs=0.1)
    assert "darker than the other in 4 of 8 frames" in found["message"]
    track(copy_frames(demo_sequence, tmp_path / "good", 8), tmp_path / "other", "klt")
    assert json.loads((tmp_path / "other" / "run.json").read_text())["checks"] == []


@pytest.mark.long
def test_a_bump_is_not_called_an_image_that_comes_again(demo_sequence: Path, tmp_path: Path):
    def lower(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return left, np.roll(right, 3 if k >= 8 else 0, axis=0)

    summary = track(copy_frames(demo_sequence, tmp_path / "sequence", 14, lower), tmp_path / "run")
    assert (summary["skipped"], summary["repeated"]) == (1, 0)
    assert "rig changed" in summary["doubts"]

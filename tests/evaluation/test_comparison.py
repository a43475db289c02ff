import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_tum, write_tum
from sigmaslam.run_record.evaluated_frames import EvaluatedFrames, write_evaluation
from sigmaslam.run_record.recorded_run import read_run
from sigmaslam_evaluation.comparison import write_comparison
from tests.support.commands import assert_refused, run_here
from tests.support.pages import Page, unpack
from tests.support.recorded_runs import INTERVAL, make_run

MOST_BYTES = 6_000_000
MOTION = np.eye(4)
MOTION[:3, :3], MOTION[:3, 3] = rotation_exp(np.array([0.1, -0.7, 0.3])), (3.0, -2.0, 8.0)


def _compare(folder: Path, *names: str) -> Page:
    return Page(write_comparison([folder / name for name in names], folder / "page.html").read_text(encoding="utf-8"))


def _two_runs(folder: Path, count: int = 60) -> None:
    """The second has another world, and only every second of the frames from the eleventh on."""
    make_run(folder / "one", count, points=50)
    shutil.copytree(folder / "one", folder / "two")
    lines = (folder / "two/frames.csv").read_text().splitlines()
    (folder / "two/frames.csv").write_text("\n".join([lines[0], *lines[11::2]]) + "\n")
    said, kept = read_tum(folder / "one/trajectory.tum"), slice(10, None, 2)
    # The frame in the middle of the first quarter has no pose.
    times = said.timestamps[0] + INTERVAL * np.arange(count)[kept]
    rows = np.flatnonzero(np.abs(said.timestamps[:, None] - times).min(axis=1) < 1e-3)
    write_tum(folder / "two/trajectory.tum", Trajectory(said.timestamps[rows], MOTION @ said.poses[rows]))
    np.save(folder / "two/covariance.npy", np.load(folder / "one/covariance.npy")[rows])
    entries = json.loads((folder / "two/run.json").read_text())
    (folder / "two/run.json").write_text(json.dumps(entries | {"command": "sigmaslam track y"}))


def test_runs_of_one_recording_lie_on_each_other(tmp_path):
    _two_runs(tmp_path)
    page = _compare(tmp_path, "one", "two")
    one, two = page.data["scenes"]
    assert (one["name"], two["name"]) == ("one", "two")
    assert one["colour"] != two["colour"]
    times, path = unpack(one["path_seconds"]), unpack(one["path"], 3)
    rows = np.abs(unpack(two["path_seconds"])[:, None] - times).argmin(axis=1)
    np.testing.assert_allclose(unpack(two["path_seconds"]), times[rows], atol=1e-5)
    np.testing.assert_allclose(unpack(two["path"], 3), path[rows], atol=1e-4)
    run, transforms = read_run(tmp_path / "one"), unpack(two["ellipsoids"], 4, 4)
    rows = [np.linalg.norm(run.trajectory.positions - T[:3, 3], axis=1).argmin() for T in transforms]
    R = run.trajectory.rotations[rows]
    expected = R @ run.covariances[rows, :3, :3] @ R.transpose(0, 2, 1)
    found = transforms[:, :3, :3] @ transforms[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(found, expected, atol=1e-5 * expected.max())
    np.testing.assert_allclose(page.values("Distance to one", "two"), 0.0, atol=1e-4)
    assert "two is aligned to the first run by the paths at 25 common times." in page.words


def test_runs_at_the_same_times_in_two_places_are_doubted(tmp_path):
    _two_runs(tmp_path)
    path = tmp_path / "two" / "trajectory.tum"
    there = read_tum(path)
    poses = there.poses.copy()
    poses[:, :3, 3] = poses[::-1, [1, 2, 0], 3] ** 2
    write_tum(path, Trajectory(there.timestamps, poses))
    assert "common times, but hardly follows it, as one of another recording." in _compare(tmp_path, "one", "two").words


def test_each_run_has_its_lines_figures_and_settings(tmp_path):
    _two_runs(tmp_path)
    page = _compare(tmp_path, "one", "two")
    assert page.open == []
    assert not [link for link in page.links if not link.startswith("data:")]
    assert len(page.identifiers) == len(set(page.identifiers))
    plot = page.plot("Error of the position")
    assert [(each["label"], each["run"]) for each in plot["series"]] == [("one 3 sigma", 0), ("two 3 sigma", 1)]
    for title, label in (("NIS", "two"), ("Matches", "two"), ("Disparity", "two"), ("Time", "two"), ("Belief", "two")):
        assert len(page.values(title, label)) == 25 == len(unpack(page.data["seconds"][1]))
    assert unpack(page.data["seconds"][1])[0] == pytest.approx(1.0)
    assert "frames 60 25" in page.words
    assert 'command "sigmaslam track x" "sigmaslam track y"' in page.words
    assert "versions" not in page.words.partition("Settings that differ")[2]
    assert "What each run says one: Tracking was lost in" in page.words


def test_runs_without_a_notice_have_no_heading_for_it(tmp_path):
    for name in ("one", "two"):
        make_run(tmp_path / name, 40, points=50)
        frames = tmp_path / name / "frames.csv"
        frames.write_text(frames.read_text().replace("lost", "tracking"))
    assert "What each run says" not in _compare(tmp_path, "one", "two").words


def test_runs_with_one_truth_are_aligned_by_it(tmp_path):
    """Paths that drift apart are not laid upon each other."""
    _two_runs(tmp_path)
    truth = read_tum(tmp_path / "one/trajectory.tum")
    drifted = read_tum(tmp_path / "two/trajectory.tum")
    drift = np.linspace(0.0, 1.0, len(drifted))[:, None] * np.array([0.0, 2.0, 0.0])
    moved = drifted.poses.copy()
    moved[:, :3, 3] += drift
    write_tum(tmp_path / "two/trajectory.tum", Trajectory(drifted.timestamps, moved))
    ate = {"rmse": 0.5, "rotation_rmse_deg": 0.5}
    errors = {"truth": "t.tum", "ate": ate, "ate_origin": ate, "rpe": {"translation_rmse": 0.01}, "nees": None}
    for name, positions in (("one", truth.positions), ("two", drifted.positions)):
        count = len(positions)
        frames = EvaluatedFrames(np.arange(count), np.ones(count), np.ones(count), np.ones(count), positions)
        write_evaluation(tmp_path / name, errors, frames)
    page = _compare(tmp_path, "one", "two")
    assert "by the truth" in page.words
    distance = page.values("Distance to one", "two")
    assert distance[-1] == pytest.approx(2.0, abs=0.05)
    assert [each["label"] for each in page.plot("Error of the position")["series"]] == [
        "one 3 sigma",
        "one error",
        "two 3 sigma",
        "two error",
    ]
    assert "ATE [m], as it was said 0.5 0.5" in page.words
    assert "truth t.tum t.tum" in page.words


def test_runs_without_common_times_stand_beside_each_other(tmp_path):
    make_run(tmp_path / "one", 40, points=50)
    make_run(tmp_path / "two", 20, points=50)
    for name in ("frames.csv", "trajectory.tum"):
        path = tmp_path / "two" / name
        path.write_text(path.read_text().replace("\n14037", "\n15037").replace("14037", "15037", name != "frames.csv"))
    page = _compare(tmp_path, "one", "two")
    assert "two has no times of the first run" in page.words
    assert not [plot for plot in page.data["plots"] if plot["title"].startswith("Distance")]
    assert unpack(page.data["scenes"][1]["path_seconds"])[0] == 0.0


def test_a_run_without_poses_is_compared_by_what_it_has(tmp_path):
    make_run(tmp_path / "one", 20, points=50)
    make_run(tmp_path / "two", 20, points=50)
    (tmp_path / "two/trajectory.tum").unlink()
    (tmp_path / "two/covariance.npy").unlink()
    page = _compare(tmp_path, "two", "one")
    assert [scene["name"] for scene in page.data["scenes"]] == ["one"]
    assert [each["label"] for each in page.plot("NIS")["series"]] == ["two", "one"]


@pytest.mark.long
def test_six_long_runs_are_a_page_of_less_than_six_megabytes(tmp_path):
    make_run(tmp_path / "0", 7000)
    for k in range(1, 6):
        shutil.copytree(tmp_path / "0", tmp_path / f"{k}")
    folders = [tmp_path / f"{k}" for k in range(6)]
    assert write_comparison(folders, tmp_path / "page.html").stat().st_size < MOST_BYTES


def test_folders_that_cannot_be_compared_are_named(tmp_path):
    make_run(tmp_path / "one", 20, points=50)
    with pytest.raises(InputError, match=r"one, .*one: a run is given twice"):
        _compare(tmp_path, "one", "one")
    with pytest.raises(InputError, match=r"none.frames\.csv: cannot read the frames: no such file"):
        _compare(tmp_path, "one", "none")
    with pytest.raises(InputError, match="7 runs are more than the 6 colours"):
        _compare(tmp_path, *(f"{k}" for k in range(7)))


def test_runs_with_one_name_have_their_folders_names_too(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        make_run(tmp_path / name / "run", 20, points=50)
    page = _compare(tmp_path, "a/run", "b/run")
    assert [scene["name"] for scene in page.data["scenes"]] == [str(tmp_path / "a/run"), str(tmp_path / "b/run")]


def test_the_command_writes_a_page_of_several_runs(tmp_path):
    for name in ("one", "two"):
        make_run(tmp_path / name, 20, points=50)
    page = tmp_path / "both.html"
    done = run_here("report", tmp_path / "one", tmp_path / "two", "--out", page)
    assert (done.returncode, done.stdout) == (0, f"Report: {page}\n")
    assert "Runs compared: one, two" in Page(page.read_text(encoding="utf-8")).words
    assert not (tmp_path / "one/report.html").exists()
    assert_refused(run_here("report", tmp_path / "one", tmp_path / "three"), "three: holds no run.json and frames.csv")

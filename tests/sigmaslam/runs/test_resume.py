"""Runs that are killed or stopped and go on: every frame has one row, in one world."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.readers import open_sequence
from sigmaslam.readers.selection import Selection
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam.run_record.relative_pose_file import read_frame_pairs
from sigmaslam.runs.resume import _SAME, _check_entries
from tests.support.commands import assert_refused, run_here
from tests.support.demo_parts import copy_frames
from tests.support.stopped_runs import end, start, statuses
from tests.support.tracked import track

FRAMES = 30


@pytest.fixture(scope="module")
def sequence(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough for some keyframes, and for poses relative to earlier ones."""
    return copy_frames(demo_sequence, tmp_path_factory.mktemp("some") / "sequence", FRAMES, slower=2.0)


@pytest.fixture(scope="module")
def whole(sequence: Path) -> Path:
    """The run that nobody disturbed."""
    run = sequence.with_name("whole")
    track(sequence, run, "klt")
    return run


def kill(sequence: Path, run: Path, rows: int, *options: str) -> None:
    """Kills a run when frames.csv has so many rows."""
    process = start(sequence, run, *options, rows=rows)
    process.kill()
    assert end(process)[0] == -signal.SIGKILL
    assert not (run / "trajectory.tum").exists()


def assert_goes_on(run: Path, whole: Path, at: list[int]) -> None:
    """The run has all poses, those before it was stopped as they were said, and the others within their sigmas."""
    table, undisturbed = read_frames(run / "frames.csv"), read_frames(whole / "frames.csv")
    np.testing.assert_array_equal(table.columns["timestamp"], undisturbed.columns["timestamp"])
    assert table.status == undisturbed.status
    trajectory, expected = (read_tum(each / "trajectory.tum") for each in (run, whole))
    covariance, spread = (np.load(each / "covariance.npy") for each in (run, whole))
    assert len(trajectory) == len(covariance) == FRAMES
    # trajectory.tum, of which a stopped run goes on, has twelve digits.
    np.testing.assert_allclose(trajectory.poses[: at[0]], expected.poses[: at[0]], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(covariance[: at[0]], spread[: at[0]])
    # The difference of two estimates of the same images is smaller than either's error.
    difference = se3_log(se3_inverse(expected.poses) @ trajectory.poses)[at[0] :]
    squared = np.einsum("ni,nij,nj->n", difference, np.linalg.inv(covariance[at[0] :]), difference)
    assert squared.max() < 12.6  # 95 % of chi-squared with 6 degrees of freedom
    pairs = read_frame_pairs(run / "relative_poses.npz", FRAMES)
    steps = se3_inverse(trajectory.poses[pairs.earlier]) @ trajectory.poses[pairs.later]
    assert np.abs(se3_log(se3_inverse(pairs.pose) @ steps)).max() < 0.05
    assert json.loads((run / "run.json").read_text())["resumed_at"] == at


@pytest.mark.long
def test_a_killed_run_goes_on_and_is_killed_again_and_goes_on(sequence: Path, whole: Path, tmp_path: Path):
    run = tmp_path / "run"
    kill(sequence, run, 13)
    with (run / "frames.csv").open("a") as table:  # a row that was not written whole
        table.write("1.3,tracki")
    kill(sequence, run, 22, "--resume")
    assert statuses(run)[13:] == ["tracking"] * 9
    result = run_here("track", sequence, "--out", run, "--frontend", "klt", "--resume")
    assert result.returncode == 0, result.stderr
    assert_goes_on(run, whole, [13, 22])
    described = json.loads((run / "run.json").read_text())
    assert described["ended"] == "complete"
    assert described["summary"]["world"] == json.loads((whole / "run.json").read_text())["summary"]["world"]
    assert described["summary"]["map_points"] > 0
    left, usual = ({path.name for path in each.iterdir()} for each in (run, whole))
    assert usual - left == {"trajectory_final.tum", "covariance_final.npy"}
    assert left <= usual
    evaluated = run_here("evaluate", run, "--truth", sequence / "poses.txt", "--json")
    assert json.loads(evaluated.stdout)["matched"] == FRAMES


@pytest.mark.long
def test_the_covariance_is_no_smaller_than_where_it_goes_on(sequence: Path, tmp_path: Path):
    run = tmp_path / "run"
    kill(sequence, run, 20)
    track(sequence, run, "klt", resume=True)
    position = np.trace(np.load(run / "covariance.npy")[:, :3, :3], axis1=1, axis2=2)
    table = read_frames(run / "frames.csv")
    keyframe = np.flatnonzero(table.columns["keyframe"][:20] == 1)[-1]
    assert keyframe > 0
    assert (position[20:] > position[keyframe]).all()


@pytest.mark.long
def test_a_stopped_run_goes_on_from_its_results(sequence: Path, whole: Path, tmp_path: Path):
    run = tmp_path / "run"
    process = start(sequence, run, rows=17)
    refused = run_here("track", sequence, "--out", run, "--frontend", "klt", "--resume")
    assert_refused(refused, "still goes on")
    process.send_signal(signal.SIGTERM)
    assert end(process)[0] == 143
    assert not (run / "poses.partial").exists()
    track(sequence, run, "klt", resume=True)
    assert_goes_on(run, whole, [17])


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize(("name", "cut"), [("poses.partial", 5), ("relative_poses.partial", 5), ("frames.csv", 3)])
def test_files_that_end_at_different_frames_are_cut_off_at_the_first(
    sequence: Path, whole: Path, tmp_path: Path, name: str, cut: int
):
    run = tmp_path / "run"
    kill(sequence, run, 16)
    os.truncate(run / name, (run / name).stat().st_size - cut)
    track(sequence, run, "klt", resume=True)
    assert_goes_on(run, whole, [16 if name == "relative_poses.partial" else 15])


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_another_input_or_other_settings_are_refused_and_change_nothing(
    sequence: Path, demo_sequence: Path, tmp_path: Path
):
    run = tmp_path / "run"
    kill(sequence, run, 8)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    with pytest.raises(InputError, match="had another input"):
        track(demo_sequence, run, "klt", resume=True)
    with pytest.raises(InputError, match="had another frontend \\(klt, now orb\\)"):
        track(sequence, run, "orb", resume=True)
    with pytest.raises(InputError, match=r"had another imu \(None, now imu\.csv\)"):
        _check_entries(run, {"map": None}, {name: "imu.csv" if name == "imu" else None for name in _SAME})
    for selection in (Selection(start=1), Selection(every=2), Selection(count=5)):
        with pytest.raises(InputError, match="run of other frames"):
            track(open_sequence(sequence).select(selection), run, "klt", resume=True)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


@pytest.mark.long
def test_what_cannot_go_on_is_refused(sequence: Path, whole: Path, tmp_path: Path):
    command = ("track", sequence, "--frontend", "klt", "--resume", "--out")
    assert_refused(run_here(*command, tmp_path / "none"), "holds no run that could go on")
    assert_refused(run_here(*command, whole), "is complete, there is nothing to go on with")
    assert_refused(run_here(*command, whole, "--overwrite"), "give one of them")
    assert_refused(run_here(*command, whole, "--track-object", "1,1,9,9"), "does not go with --track-object")
    for option in ("--realtime", "--tracks"):
        assert_refused(run_here(*command, whole, option), f"does not go with {option}")
    assert_refused(run_here(*command, whole, "--map", whole / "map.npz"), "does not go with --map")

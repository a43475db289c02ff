"""Runs that are killed, stopped, or out of disk: every pose that was said is kept."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam.run_record.relative_pose_file import read_frame_pairs
from sigmaslam.runs.finish import finish_run
from tests.support.commands import assert_refused, environment, run_here, run_process
from tests.support.demo_parts import copy_frames
from tests.support.stopped_runs import end, start, statuses
from tests.support.tracked import track

FRAMES = 12
PARTIAL = ("poses.partial", "relative_poses.partial")
POSES = (
    "trajectory.tum",
    "trajectory.kitti",
    "times.txt",
    "covariance.npy",
    "covariance_matching.npy",
    "relative_poses.npz",
)


@pytest.fixture(scope="module")
def sequence(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second or two, so that there are poses relative to earlier ones."""
    return copy_frames(demo_sequence, tmp_path_factory.mktemp("some") / "sequence", FRAMES, slower=4.0)


@pytest.fixture(scope="module")
def whole(sequence: Path) -> Path:
    """The run that nobody disturbed."""
    run = sequence.with_name("whole")
    track(sequence, run, "klt")
    return run


def assert_first_poses_of(whole: Path, run: Path, count: int) -> None:
    """The run has the first poses of another one, to the bit, and what goes with them."""
    for name in ("trajectory.tum", "trajectory.kitti", "times.txt"):
        assert (run / name).read_text().splitlines() == (whole / name).read_text().splitlines()[:count], name
    for name in ("covariance.npy", "covariance_matching.npy"):
        np.testing.assert_array_equal(np.load(run / name), np.load(whole / name)[:count])
    pairs, all_pairs = (
        read_frame_pairs(folder / "relative_poses.npz", length) for folder, length in ((run, count), (whole, FRAMES))
    )
    assert len(all_pairs)
    first = all_pairs.select(all_pairs.later < count)
    np.testing.assert_array_equal(pairs.pose, first.pose)
    np.testing.assert_array_equal(pairs.earlier, first.earlier)


@pytest.mark.long
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)])
def test_a_signal_ends_a_run_with_its_results(
    sequence: Path, whole: Path, tmp_path: Path, number: signal.Signals, code: int
):
    run = tmp_path / "run"
    process = start(sequence, run)
    # The second and the third come while the results are written, or just before.
    for _ in range(3):
        process.send_signal(number)
        time.sleep(0.1)
    returned, output, errors = end(process)
    assert returned == code, errors
    assert "Traceback" not in errors
    assert f"Stopped; what was tracked until then is in {run}" in output
    assert_first_poses_of(whole, run, 4)
    described = json.loads((run / "run.json").read_text())
    assert described["ended"] == "interrupted" + ("" if number == signal.SIGINT else f" by {number.name}")
    assert described["summary"]["poses"] == len(read_tum(run / "trajectory_final.tum")) == 4
    assert {path.name for path in whole.iterdir()} == {path.name for path in run.iterdir()}
    assert run_here("report", run).stdout == f"Report: {run / 'report.html'}\n"


@pytest.mark.long
def test_poses_of_a_run_whose_folder_is_removed_are_kept(sequence: Path, whole: Path, tmp_path: Path):
    run = tmp_path / "run"
    process = start(sequence, run)
    shutil.rmtree(run)
    process.send_signal(signal.SIGTERM)
    returned, _, errors = end(process)
    assert returned == 143, errors
    assert "Traceback" not in errors
    assert "was removed while the run goes on" in " ".join(errors.split())
    assert_first_poses_of(whole, run, 4)
    assert {path.name for path in whole.iterdir()} == {path.name for path in run.iterdir()}


@pytest.mark.long
def test_finish_makes_the_results_of_a_killed_run(sequence: Path, whole: Path, tmp_path: Path):
    run = tmp_path / "run"
    process = start(sequence, run)
    refused = run_here("report", run)
    assert_refused(refused, "still goes on")
    assert_refused(run_here("evaluate", run, "--truth", sequence / "poses.txt"), "it still goes on")
    process.kill()
    assert end(process)[0] == -signal.SIGKILL
    assert not (run / "trajectory.tum").exists()
    (run / ".poses.0123456789ab.csv").write_text("cut off")
    assert_refused(run_here("evaluate", run, "--truth", sequence / "poses.txt"), f"`sigmaslam report {run}`")

    result = run_here("report", run)
    assert result.returncode == 0, result.stderr
    assert "3 of 4 frames tracked, 1 starting, 0 lost, 0 skipped" in result.stdout
    assert_first_poses_of(whole, run, 4)
    described, undisturbed = (json.loads((each / "run.json").read_text()) for each in (run, whole))
    assert described["ended"] == "killed"
    for name in ("input", "frontend", "configuration", "calibration", "weights_sha256"):
        assert described[name] == undisturbed[name]
    assert "window.report" in (run / "report.html").read_text()
    assert not any((run / name).exists() for name in (*PARTIAL, ".poses.0123456789ab.csv"))
    evaluated = run_here("evaluate", run, "--truth", sequence / "poses.txt", "--json")
    assert json.loads(evaluated.stdout)["matched"] == 4

    again = run_here("report", run)
    assert (again.returncode, again.stdout) == (0, f"Report: {run / 'report.html'}\n")


@pytest.fixture
def killed(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that tracked everything and was killed before it wrote any result."""

    def killed(*_: object) -> None:
        raise SystemExit

    run = tmp_path / "killed"
    monkeypatch.setattr("sigmaslam.runs.track.write_results", killed)
    with pytest.raises(SystemExit):
        track(sequence, run, "klt")
    return run


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize(
    ("name", "cut", "poses"),
    [
        ("poses.partial", 1, FRAMES - 1),
        ("poses.partial", 700, FRAMES - 1),
        ("relative_poses.partial", 5, FRAMES),
        ("frames.csv", 9, FRAMES - 1),
    ],
)
def test_a_last_record_that_is_cut_off_is_left_out(killed: Path, whole: Path, name: str, cut: int, poses: int):
    os.truncate(killed / name, (killed / name).stat().st_size - cut)
    assert finish_run(killed) is not None
    if name == "relative_poses.partial":
        left, whole_pairs = (read_frame_pairs(run / "relative_poses.npz", FRAMES) for run in (killed, whole))
        np.testing.assert_array_equal(left.pose, whole_pairs.pose[:-1])
    else:
        assert_first_poses_of(whole, killed, poses)
    assert len(read_tum(killed / "trajectory.tum")) == poses
    assert len(read_frames(killed / "frames.csv")) >= poses


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_finish_of_a_run_that_did_not_track_ends_like_it(demo_sequence: Path, tmp_path: Path):
    swapped = copy_frames(demo_sequence, tmp_path / "sequence", 3, lambda k, left, right: (right, left))
    run = tmp_path / "run"
    tracked = run_here("track", swapped, "--out", run, "--frontend", "klt")
    assert tracked.returncode == 3
    assert "0 of 3 frames tracked, 3 starting" in tracked.stdout
    assert len(tracked.stderr.strip().splitlines()[-1]) > 20  # after the progress, why
    process = start(swapped, tmp_path / "killed", rows=3)
    process.kill()
    end(process)
    finished = run_here("report", tmp_path / "killed")
    assert finished.returncode == 3
    assert "left and right are exchanged" in finished.stderr


@pytest.mark.long
def test_finish_of_a_run_without_a_frame_says_so(killed: Path):
    for name in ("frames.csv", *PARTIAL):
        content = (killed / name).read_bytes()
        (killed / name).write_bytes(content[: content.find(b"\n") + 1] if name == "frames.csv" else b"")
    finished = run_here("report", killed)
    assert finished.returncode == 3
    assert "There was no frame" in finished.stderr


def test_finish_refuses_what_is_no_run(tmp_path: Path):
    assert_refused(run_here("report", tmp_path), "holds no run.json and frames.csv")


# ---- a full disk


def full_for(names: set[str]) -> Callable[[Path], object]:
    """`atomic_path` on a disk without room for these files."""
    from sigmaslam.files import atomic_path

    def limited(path: Path) -> object:
        if Path(path).name in names:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return atomic_path(path)

    return limited


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("name", ["trajectory.tum", "covariance.npy", "trajectory_final.tum", "map.npz", "run.json"])
def test_a_file_without_room_costs_a_message_and_not_the_others(
    sequence: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
):
    with monkeypatch.context() as disk:
        disk.setattr("sigmaslam.files.atomic_path", full_for({name}))
        if name == "run.json":  # there was room for it when the run began
            disk.setattr(
                "sigmaslam.run_record.run_folder.atomic_write_json", lambda p, run: p.write_text(json.dumps(run))
            )
        result = run_here("track", sequence, "--out", tmp_path / "run", "--frontend", "klt")
    assert_refused(result, f"could not write {name}; make room", "No space left on device")
    lost = {name} | ({"covariance_final.npy"} if name == "trajectory_final.tum" else set())
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left - set(PARTIAL) == {path.name for path in whole.iterdir()} - (lost - {"run.json"}) - {"report.html"}
    can_be_made = name in (*POSES, "run.json")
    assert left & set(PARTIAL) == (set(PARTIAL) if can_be_made else set())
    if can_be_made:
        assert "sigmaslam report" in result.stderr
        assert run_here("report", tmp_path / "run").returncode == 0
        summary = json.loads((tmp_path / "run" / "run.json").read_text())["summary"]
        undisturbed = json.loads((whole / "run.json").read_text())["summary"]
        assert summary == undisturbed
    for each in POSES[:-1]:
        assert (tmp_path / "run" / each).read_bytes() == (whole / each).read_bytes(), each


@pytest.mark.long
def test_a_disk_that_is_full_in_the_midst_of_a_run_keeps_what_was_said(sequence: Path, whole: Path, tmp_path: Path):
    """No file may grow beyond 5 kB: some poses fit, and no result does."""
    script = (
        "import resource\n"
        "from sigmaslam.cli import main\n"
        "from sigmaslam.slam.tracker import StereoTracker\n"
        "from sigmaslam.run_record.run_folder import RunWriter\n"
        "begin = RunWriter.__init__\n"
        "def fill(*arguments):\n"
        "    begin(*arguments)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))\n"
        "RunWriter.__init__ = fill\n"
        "main()\n"
    )
    run = tmp_path / "run"
    command = [sys.executable, "-c", script, "track", str(sequence), "--out", str(run), "--frontend", "klt"]
    result = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False, timeout=60)
    assert_refused(result, "poses.partial: cannot be written")
    count = len(statuses(run))
    assert 3 <= count < FRAMES
    finished = run_here("report", run)
    assert finished.returncode == 0, finished.stderr
    assert_first_poses_of(whole, run, count)


# ---- names


@pytest.mark.long
def test_an_input_whose_name_is_no_text_is_tracked(sequence: Path, tmp_path: Path):
    """Bytes that are no UTF-8, in the names of input and output."""
    source = Path(os.fsdecode(os.fsencode(tmp_path) + b"/in\xff"))
    run = Path(os.fsdecode(os.fsencode(tmp_path) + b"/out\xfe"))
    shutil.copytree(sequence, source)
    result = run_process("track", source, "--out", run, "--frontend", "klt")
    assert result.returncode == 0, result.stderr
    assert json.loads((run / "run.json").read_text())["input"].endswith("in\\udcff")
    assert "out\\udcfe" in (run / "report.html").read_text()
    assert "out\\udcfe" in result.stdout

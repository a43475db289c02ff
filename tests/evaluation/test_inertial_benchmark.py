"""The benchmark of the inertial sensor: its errors on known answers, its page, and a short run."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.estimation.constant_velocity import MotionState
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam_benchmarks.inertial import dark_runs, inertial_benchmark
from sigmaslam_benchmarks.inertial.dark_runs import METHODS, STATES, DarkResult
from sigmaslam_benchmarks.inertial.inertial_page import InertialPage, format_page
from sigmaslam_benchmarks.live import recording_jobs, recordings
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame
from sigmaslam_benchmarks.live.judge import References
from sigmaslam_benchmarks.live.recordings import GoodFrames, Recording
from sigmaslam_synthetic.inertial import SimulatedInertial, simulate_inertial
from sigmaslam_synthetic.layouts import save_arrays
from sigmaslam_synthetic.motion.random_motions import FreeSpace, hand_held
from tests.support.simulated_stereo import parallel_camera

TIMES = 0.05 * np.arange(30)
KEYFRAME, FRAME = 12, 20
SIGMA = np.array([5e-3] * 3 + [2e-3] * 3 + [0.02] * 3 + [0.05] * 3 + [1e-3] * 3 + [0.05] * 3 + [1e-3] * 7)


@pytest.fixture(scope="module")
def walk() -> tuple[SimulatedInertial, np.ndarray]:
    """A sensor, and the true poses of the frames."""
    path = hand_held(np.random.default_rng(3), 3.0, FreeSpace((0, 0, 1.5), (1.5, 1.5, 0.3)))
    rng = np.random.default_rng(0)
    return simulate_inertial(path, float(TIMES[-1]), 200.0, rng, np.eye(4)), path.poses(TIMES)


@pytest.fixture
def good(walk: tuple[SimulatedInertial, np.ndarray], tmp_path: Path) -> GoodFrames:
    sensor, poses = walk
    save_arrays(tmp_path / "truth.npz", asdict(sensor.truth))
    image = np.zeros((4, 4), np.uint8)
    frames = [DrivenFrame(k, float(t), image, image) for k, t in enumerate(TIMES)]
    imu = InertialRecording(tmp_path / "data.csv", sensor.sensor, sensor.samples)
    return GoodFrames(frames, parallel_camera(64, 48, 50.0, 0.1), References(poses), imu)


@pytest.mark.long
def test_errors_drawn_from_the_covariance_have_a_nees_of_one(good, walk):
    truth, poses = walk[0].truth, walk[1]
    rng, mix = np.random.default_rng(1), np.random.default_rng(2).standard_normal((25, 25)) / 5.0
    root = SIGMA[:, None] * (np.eye(25) + mix)  # all states correlate with all
    R = poses[KEYFRAME][:3, :3].T
    row = int(np.argmin(np.abs(truth.timestamp - TIMES[FRAME] - truth.time_shift)))
    step = np.linalg.inv(poses[KEYFRAME]) @ poses[FRAME]
    vectors = [R @ truth.velocity[row], R @ truth.gravity, truth.gyro_bias[row], truth.accel_bias[row], np.zeros(7)]
    found: dict[str, list[float]] = {}
    for _ in range(400):
        error = root @ rng.standard_normal(25)
        others = np.concatenate(vectors) - error[6:]
        motion = MotionState(se3_exp(-error[:6]) @ step, others, root @ root.T)
        frame = dark_runs._Tracked("inertial", poses[FRAME], np.eye(6), KEYFRAME, motion, True, 0.0)
        for name, value in dark_runs._state_errors(frame, good, FRAME).items():
            found.setdefault(name, []).append(value)
        sigmas, nees = dark_runs._pose_sigmas(frame, good, FRAME)
        found.setdefault("pose", []).append(nees)
        found.setdefault("position", []).append(sigmas**2 / 3.0)
    for name in (*STATES, "pose", "position"):
        assert np.mean(found[name]) == pytest.approx(1.0, abs=0.15), name
    ratio = np.sqrt(np.mean(np.square(found["tilt"]))) / np.mean(found["tilt sigma"])
    assert ratio == pytest.approx(1.0, abs=0.1)


RESULT = DarkResult(
    20, 20, 0, 0.0, 0.0, 0.02, 0.1, 1.2, 0.001, 1.1, 1.3, dict.fromkeys(STATES, 1.2), 0.4, 0.5, 0.003, 50.0, 1.0
)


def test_the_page_says_which_goals_are_missed():
    room, mh01 = Recording("room7", "room", 170, 7, 200.0), Recording("mh01", "mh01", 100, 7)
    bad = replace(RESULT, end_metres=0.07, end_sigmas=3.0, lost=2, back=-1.0)
    runs = {}
    for recording, result in ((room, RESULT), (mh01, bad)):
        for method in METHODS:
            runs[recording, method, 0, 0.0] = RESULT
            runs[recording, method, 20, 0.5] = replace(result, back=np.nan)
            runs[recording, method, 20, 1.0] = result
    page = format_page(InertialPage("sigmaslam benchmark inertial", runs, 3))
    assert "| MH_01, 1 s: frames lost | 0 | 2, **missed** |" in page
    assert "| MH_01, 1 s: largest error, m | 0.05 | 0.070, **missed** |" in page
    assert "| renders with images: NEES of gyro bias | 0.7 - 1.4 | 1.20 |" in page
    assert "Missed: MH_01, 1 s: frames lost (2)" in page
    assert "**3 runs are missing: the same command goes on.**" in page
    assert "| room | 1 | images | 1 | 20 | 20 | 0 | 0.020 | 0.020 | 0.10 | 100% | 1.10 | 1.30 |" in page
    assert "| mh01 | 1 | both sensors | 1 | 0 | 1 | 0 | 0.001 | 0.001 |" in page
    assert "| mh01 | 0.5 | both sensors | 1 | 0 " not in page


def test_a_dark_stretch_leaves_frames_after_it(tmp_path):
    (tmp_path / recordings.REAL["mh01"][0]).mkdir()
    for recording in recordings.choose_recordings(None, tmp_path, 100, 2, inertial_benchmark.FRAMES, 200.0):
        rate = 10.0 if recording.kind == "street" else 20.0
        cases = inertial_benchmark.dark_cases(recording, METHODS)
        assert max(case.first + round(case.marks[-1] * rate) for case in cases) <= recording.frames - 5
        assert {seconds for case in cases for seconds in case.marks} >= {0.0, 0.5, 1.0, 2.0}
        assert len({case.name for case in cases}) == len(cases)


def test_a_run_is_judged_after_each_while_in_the_dark_and_what_follows_at_its_end(good, walk):
    poses = walk[1]
    dark = range(10, 20)
    tracked = []
    for k, pose in enumerate(poses):
        away = np.eye(4)
        away[0, 3] = 1e-3 * max(0, min(k, dark.stop - 1) - 9)
        step = np.linalg.inv(poses[5]) @ pose
        motion = MotionState(step, np.zeros(19), np.diag(SIGMA**2))
        status = "inertial" if k in dark else "tracking"
        tracked.append(dark_runs._Tracked(status, pose @ away, (5e-3) ** 2 * np.eye(6), 5, motion, False, 0.1))
    half, whole = (dark_runs._judge(tracked, good, range(10, stop), stop == 20) for stop in (15, 20))
    assert [half.dark, half.inertial, whole.dark] == [5, 5, 10]
    assert [half.end_metres, whole.end_metres] == pytest.approx([5e-3, 10e-3])
    assert np.isnan([half.back, half.after_metres]).all()
    assert [whole.back, whole.after_metres] == pytest.approx([0, 10e-3])
    # With images the published poses are judged: right to frame 9, two sigmas off from frame 20 on.
    light = dark_runs._judge(tracked, good, range(0), is_last=True)
    share = (len(poses) - 20) / (len(poses) - 11)
    assert [light.nees, light.place_nees] == pytest.approx([4.0 / 6.0 * share, 4.0 / 3.0 * share])


@pytest.mark.slow
def test_the_command_judges_a_short_render_and_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("torch")

    def run_here(work, jobs, workers, ended):
        for job in jobs:
            ended(job, work(job))

    monkeypatch.setitem(recordings.RENDERED, "room", (160, 120))
    monkeypatch.setitem(inertial_benchmark.FRAMES, "room", 45)
    monkeypatch.setitem(inertial_benchmark._STARTS, "room", (26,))
    monkeypatch.setattr(inertial_benchmark, "_STRETCHES", ((0.0,), (0.2, 0.5)))
    monkeypatch.setattr(recording_jobs, "run_jobs", run_here)
    words = ["benchmark", "inertial", "--out", str(tmp_path / "page.md"), "--runs", str(tmp_path / "runs")]
    words += ["--seeds", "1", "--first-seed", "8", "--worlds", "room"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    page = (tmp_path / "page.md").read_text()
    assert "| room | 0.5 | both sensors | 1 | 10 |" in page
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("*.json")}
    assert len(kept) == 6
    assert CliRunner().invoke(app, words).exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("*.json")} == kept

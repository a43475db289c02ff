"""The benchmark of live cameras: its judge on known answers, and a short run of the command."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam_benchmarks.live import recording_jobs, recordings
from sigmaslam_benchmarks.live.driven_runs import DrivenSequence
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame, spoil
from sigmaslam_benchmarks.live.judge import DrivenPose, Judgement, References, good_poses, judge, pose_errors
from sigmaslam_benchmarks.live.live_page import LivePage, format_page
from sigmaslam_benchmarks.live.recordings import Recording
from sigmaslam_evaluation.metrics.truth_covariance import truth_covariance
from tests.support.simulated_stereo import parallel_camera

SIGMA = np.array([0.02, 0.03, 0.04, 0.001, 0.002, 0.003])
COVARIANCE = np.diag(SIGMA**2)
CAMERA = parallel_camera(64, 48, 50.0, 0.1)
NONE = np.full((4, 4), np.nan)


def straight(count: int) -> np.ndarray:
    """Half a metre a frame, in a world that is not that of the first frame."""
    start = se3_exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.1]))
    return np.stack([start @ se3_exp(np.array([0.0, 0.0, 0.5 * k, 0.0, 0.01 * k, 0.0])) for k in range(count)])


def estimated(true: np.ndarray, errors: np.ndarray, statuses: list[str] | None = None) -> list[DrivenPose]:
    """Poses in the world of the first one, off by tangents (N, 6)."""
    start = np.linalg.inv(true[0])
    return [
        DrivenPose(k, statuses[k] if statuses else "tracking" if k else "starting", start @ pose @ se3_exp(error),
                   COVARIANCE if k else np.zeros((6, 6)))
        for k, (pose, error) in enumerate(zip(true, errors, strict=True))
    ]  # fmt: skip


def test_right_poses_are_beyond_their_bounds_as_rarely_as_the_bounds_say():
    rng, true = np.random.default_rng(0), np.repeat(straight(1), 5_000, axis=0)
    errors = rng.standard_normal((len(true), 6)) * SIGMA
    errors[0] = 0.0
    found = pose_errors(estimated(true, errors), References(true))
    assert np.isnan(found.pose[0])
    assert (found.position[1:] > chi2.isf(0.05, 3)).mean() == pytest.approx(0.05, abs=0.01)
    assert (found.pose[1:] > chi2.isf(0.05, 6)).mean() == pytest.approx(0.05, abs=0.01)
    assert 0.0002 < found.beyond.mean() < 0.004


def test_a_wrong_position_is_wrong_where_it_is_called_tracking():
    true = straight(10)
    errors = np.zeros((10, 6))
    errors[4:7, 0] = 0.1  # 5 sigmas
    errors[8, 0] = 0.06  # 3 sigmas
    statuses = ["starting", *["tracking"] * 4, "lost", "relocalised", *["tracking"] * 3]
    found = judge(estimated(true, errors, statuses), References(true))
    assert found.wrong == [4]
    assert found.judged == 7
    assert found.statuses == {"starting": 1, "tracking": 7, "lost": 1, "relocalised": 1}
    assert (found.metres, found.sigmas, found.end_metres) == pytest.approx((0.1, 5.0, 0.0))
    assert found.silent() == 1
    assert found.silent(found) == 0


def test_a_turn_alone_is_wrong_too():
    true = straight(3)
    errors = np.zeros((3, 6))
    errors[2, 4] = 0.012  # 6 sigmas of the turn about y
    assert judge(estimated(true, errors), References(true)).wrong == [2]


def test_a_truth_that_was_measured_excuses_what_it_cannot_see_and_the_good_run_does_not():
    true = straight(4)
    errors = np.zeros((4, 6))
    errors[3, 0] = 0.2
    good_run = estimated(true, np.zeros((4, 6)))
    good = good_poses(good_run, 4)
    measured = References(true, truth_covariance(0.2, 0.05))
    found = judge(estimated(true, errors), measured, good)
    assert found.wrong == []
    assert found.away_wrong == [3]
    assert (found.away_metres, found.away_sigmas) == pytest.approx((0.2, 10.0))
    assert (found.silent(), found.silent(judge(good_run, measured))) == (0, 1)


def test_truth_is_looked_up_by_moment_and_the_start_is_the_first_pose():
    true = straight(12)
    moments = [3, 5, 6, 11]
    start = np.linalg.inv(true[5])
    poses = [DrivenPose(3, "starting", NONE, None)]
    poses += [
        DrivenPose(k, "tracking", start @ true[k], COVARIANCE if k > 5 else np.zeros((6, 6))) for k in moments[1:]
    ]
    found = judge(poses, References(true))
    assert (found.judged, found.wrong) == (2, [])
    assert found.metres == pytest.approx(0.0, abs=1e-12)


def test_without_covariance_or_pose_nothing_is_wrong_in_sigmas():
    true = straight(3)
    poses = [
        DrivenPose(k, "tracking", np.linalg.inv(true[0]) @ true[k] @ se3_exp(np.eye(6)[2] * k), None) for k in range(3)
    ]
    found = judge(poses, References(true))
    assert (found.judged, found.wrong) == (0, [])
    assert found.metres == pytest.approx(2.0)
    assert np.isnan(found.sigmas)
    nothing = judge([DrivenPose(0, "refused", NONE, None)], References(true), refused="stamps")
    assert nothing.refused == "stamps"
    assert np.isnan(nothing.metres)


def test_a_sequence_knows_which_delivered_frame_was_read_last():
    image = np.zeros((CAMERA.left.height, CAMERA.left.width), np.uint8)
    frames = spoil("bursts_3", [DrivenFrame(k, 0.1 * k, image + k, image) for k in range(6)], 0)
    sequence = DrivenSequence(frames, CAMERA)
    for number, frame in enumerate(sequence.frames()):
        assert sequence.latest == number
        assert frame.timestamp == frames[number].timestamp


def test_the_page_counts_silent_frames_by_case_and_names_what_is_missing():
    true = straight(6)
    errors = np.zeros((6, 6))
    good = judge(estimated(true, errors), References(true))
    errors[4, 0] = 1.0
    bad = judge(estimated(true, errors), References(true))
    room = Recording("room7", "room", 6, 7)
    found: dict[tuple[Recording, str, str], Judgement | str] = {
        (room, "ours", "none"): good,
        (room, "ours", "jitter_20"): bad,
        (room, "ours", "covered_5"): "longer than the recording",
    }
    page = format_page(
        LivePage("sigmaslam benchmark live", ["none", "jitter_20", "covered_5", "torn"], ["ours"], found, 6, 4)
    )
    assert "| ours | 2 | 10 | 1 |" in page
    assert "**1 runs are missing: the same command goes on.**" in page
    assert "Left out: longer than the recording." in page
    assert "seeds 7," in page


def run_here(work: Callable[[Any], str], jobs: Sequence[Any], workers: int, ended: Callable[[Any, str], None]) -> None:
    for job in jobs:
        ended(job, work(job))


@pytest.mark.long
def test_the_command_judges_a_short_render_and_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("torch")
    monkeypatch.setitem(recordings.RENDERED, "room", (160, 120))
    monkeypatch.setattr(recording_jobs, "run_jobs", run_here)
    words = ["benchmark", "live", "--out", str(tmp_path / "live.md"), "--runs", str(tmp_path / "runs")]
    words += ["--seeds", "1", "--first-seed", "8", "--frames", "20", "--sequences", "room"]
    words += ["--methods", "klt-pnp", "--cases", "none,frozen_5"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    page = (tmp_path / "live.md").read_text()
    assert "| klt-pnp | 2 | 38 |" in page
    assert "--first-seed 8" in page
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("*.json")}
    assert len(kept) == 2
    assert CliRunner().invoke(app, words).exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("*.json")} == kept

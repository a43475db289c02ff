"""The benchmark of the shaken camera: errors in sigmas, flows and the page, on known answers."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, norm

from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoSequence
from sigmaslam_benchmarks.tracking import shake, trial_pool
from sigmaslam_benchmarks.tracking.claimed_errors import motion_errors, sigmas_of_pose
from sigmaslam_benchmarks.tracking.image_motion import ImageMotion, largest_reversal, read_image_motion
from sigmaslam_benchmarks.tracking.shake import FRAMES, MOVERS, judge, recipe
from sigmaslam_benchmarks.tracking.shake_page import ShakenSequence, ShakeResult, format_page
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer
from sigmaslam_benchmarks.trial import render
from sigmaslam_synthetic.simulation import Recipe

GOOD = ShakeResult(
    tracking=59,
    lost=0,
    ate=0.004,
    path_length=1.0,
    nees=1.0,
    inside=0.95,
    wrong_step=[],
    wrong_second=[],
    wrong_start=[],
)
STILL = ShakenSequence("room1000", (640, 480), 0.0, ImageMotion(40.0, 75.0, 20.0))
MOVING = ShakenSequence("room1001", (640, 480), 0.3, ImageMotion(35.0, 60.0, 17.5))


def walk(rng: np.random.Generator, count: int) -> Trajectory:
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3_exp(rng.normal(0.0, 0.2, 6)))
    return Trajectory(np.arange(count) / 20.0, np.stack(poses))


def test_sigmas_are_those_of_a_gaussian_that_is_passed_as_rarely():
    squares = np.array([0.5, 5.348, 12.592, 40.0])
    assert sigmas_of_pose(squares) == pytest.approx(norm.isf(0.5 * chi2.sf(squares, 6)))
    assert sigmas_of_pose(np.array([chi2.isf(2 * norm.sf(5.0), 6)])) == pytest.approx([5.0])
    far = sigmas_of_pose(np.array([1e4, 1e8]))  # where the tail underflows
    assert far == pytest.approx([100.0, 1e4], rel=0.01)


def test_errors_of_independent_poses_are_in_sigmas_what_was_drawn():
    rng = np.random.default_rng(0)
    truth = walk(rng, 3000)
    factor = rng.normal(0.0, 1.0, (6, 6)) * [0.01, 0.01, 0.01, 0.001, 0.001, 0.001]
    covariance = np.broadcast_to(factor.T @ factor, (3000, 6, 6)).copy()
    covariance[0] = 0.0
    errors = rng.standard_normal((3000, 6)) @ factor
    errors[0] = 0.0
    estimate = Trajectory(truth.timestamps, truth.poses @ se3_inverse(se3_exp(errors)))
    for frames in (1, 20, None):
        found = motion_errors(estimate, truth, covariance, frames)
        assert np.isnan(found[: frames or 1]).all()
        judged = found[frames or 1 :]
        # As many inside one sigma and two as of a Gaussian.
        assert (judged < 1.0).mean() == pytest.approx(0.683, abs=0.03)
        assert (judged < 2.0).mean() == pytest.approx(0.954, abs=0.015)


def test_one_wrong_step_is_found_where_it_is_and_for_a_while_after():
    truth = walk(np.random.default_rng(1), 60)
    jump = se3_exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]))
    poses = truth.poses.copy()
    # From frame 30 on, all is moved as that frame is.
    poses[30:] = poses[30] @ jump @ se3_inverse(poses[30]) @ poses[30:]
    covariance = np.broadcast_to(1e-6 * np.eye(6), (60, 6, 6))
    estimate = Trajectory(truth.timestamps, poses)
    step, second, start = (motion_errors(estimate, truth, covariance, frames) for frames in (1, 20, None))
    assert np.flatnonzero(step > 5).tolist() == [30]
    assert np.flatnonzero(second > 5).tolist() == list(range(30, 50))
    assert np.flatnonzero(start > 5).tolist() == list(range(30, 60))
    # Against the covariances of both poses, which are one millimetre and one milliradian large.
    adjoint = se3_adjoint(se3_inverse(truth.poses[29]) @ poses[30])
    claimed = 1e-6 * (np.eye(6) + np.linalg.inv(adjoint) @ np.linalg.inv(adjoint).T)
    error = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert step[30] == pytest.approx(sigmas_of_pose(np.array([error @ np.linalg.solve(claimed, error)]))[0])


def test_covariances_of_another_length_are_refused():
    truth = walk(np.random.default_rng(2), 5)
    with pytest.raises(ValueError, match=r"\(5, 6, 6\), not \(4, 6, 6\)"):
        motion_errors(truth, truth, np.zeros((4, 6, 6)))


def test_a_reversal_counts_within_its_reach_alone():
    flows = np.array([[30.0, 0.0], [0.0, 4.0], [-10.0, 0.0], [np.nan, 0.0], [-25.0, 0.0]])
    assert largest_reversal(flows, 1) == pytest.approx(math.hypot(30.0, 4.0))
    assert largest_reversal(flows, 2) == pytest.approx(40.0)
    assert largest_reversal(flows, 4) == pytest.approx(55.0)
    assert math.isnan(largest_reversal(flows[:1], 3))


def test_every_second_sequence_has_movers_and_all_worlds_take_turns():
    recipes = [recipe(number, 1000) for number in range(12)]
    assert [each.movers for each in recipes] == [0.0, MOVERS] * 6
    assert [each.preset for each in recipes[:6]] == ["room", "room", "drone", "drone", "rubble", "rubble"]
    assert [each.seed for each in recipes] == list(range(1000, 1012))
    assert {(each.motion, each.sensor, each.frames) for each in recipes} == {("shaken", "slow", FRAMES)}


@pytest.fixture(scope="module")
def shaken_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few frames of a shaken room."""
    recipe = Recipe("room", 8, 7, "shaken", sensor="slow", width=240, height=180)
    return render(tmp_path_factory.mktemp("renders"), recipe, 1)


@pytest.mark.long
def test_flow_and_blur_of_a_render_are_those_of_its_dense_truth(shaken_folder: Path, tmp_path: Path):
    from sigmaslam_synthetic.simulation import Studio, simulate

    recipe = Recipe("room", 8, 7, "shaken", sensor="slow", width=240, height=180)
    studio = Studio(simulate(recipe))
    flows = np.stack([np.nanmedian(frame.flow, axis=(0, 1)) for frame in studio.frames(np.arange(7))])
    found = read_image_motion(shaken_folder)
    assert found.flow == pytest.approx(np.linalg.norm(flows, axis=1).max(), rel=0.1)
    assert found.reversal == pytest.approx(largest_reversal(flows, 10), rel=0.1)
    assert found.blur_left == pytest.approx(0.5 * found.flow)


def test_a_method_that_is_right_has_no_wrong_frame_and_one_that_jumps_has(shaken_folder: Path):
    right = judge(shaken_folder, lambda sequence, out: track_with_peer(sequence, out, "klt-pnp"))

    def jumping(sequence: StereoSequence, out: Path) -> None:
        track_with_peer(sequence, out, "klt-pnp")
        rows = (out / "trajectory.tum").read_text().splitlines()
        words = rows[5].split()
        rows[5] = " ".join([words[0], str(float(words[1]) + 0.5), *words[2:]])
        (out / "trajectory.tum").write_text("\n".join(rows) + "\n")

    wrong = judge(shaken_folder, jumping)
    assert right.tracking == wrong.tracking == 7
    assert not {5, 6} & set(right.wrong_step)
    assert {5, 6} <= set(wrong.wrong_step)


def test_the_page_counts_wrong_frames_and_says_what_is_missed():
    wrong = replace(GOOD, ate=0.02, wrong_step=[3, 4], wrong_second=[22], wrong_start=[22, 23, 24])
    page = format_page(
        {"ours": {STILL: GOOD, MOVING: wrong}, "KLT + PnP": {STILL: wrong, MOVING: GOOD}}, 60, (1000, 2), "c"
    )
    assert "Missed: frames wrong over a frame (2); frames wrong over 1 s (1); frames wrong since the start (3)" in page
    assert "median ATE (1.20 %)." in page
    assert "2 of 118, **missed**" in page
    assert "seeds 1000 to 1001" in page
    assert "reaches 35.0 to 40.0 px a frame" in page
    assert "| all | ours | 118 | 0 | 1.20 |" in page
    assert "| with movers | ours | 59 | 0 | 2.00 | 2.00 - 2.00 | 2.00 | 2 | 1 | 3 |" in page
    tables = [line for line in page.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in tables} == {4, 13}
    assert "All goals are met." in format_page({"ours": {STILL: GOOD}}, 60, (1000, 2), "c")


def test_what_was_found_is_kept_until_the_code_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def run_here(work, jobs, workers, ended, ray):
        for job in jobs:
            ended(job, work(job))

    monkeypatch.setattr(trial_pool, "run_jobs", run_here)
    monkeypatch.setattr(trial_pool, "render", lambda folder, recipe, workers: folder / recipe.name)
    monkeypatch.setattr(shake, "read_image_motion", lambda source: STILL.motion)
    judged = []
    monkeypatch.setattr(shake, "judge", lambda source, method: judged.append(source.name) or GOOD)
    page = shake.write_shake(tmp_path / "page.md", tmp_path / "runs", 4, 1, "the command")
    assert judged == ["room43000"] * 2 + ["room43001"] * 2 + ["drone43002"] * 2 + ["drone43003"] * 2
    assert "All goals are met." in page
    assert "480" in page
    assert shake.write_shake(tmp_path / "page.md", tmp_path / "runs", 4, 1, "the command") == page
    assert len(judged) == 8

"""Every frame after the fact: nearer to the truth than what was said at once, and as sure as it may be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionState
from sigmaslam.estimation.held_offset import HeldOffset
from sigmaslam.estimation.published_state import published_state
from sigmaslam.estimation.state_layout import pose_slice
from sigmaslam.frontend.types import StereoView
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.slam.estimate import CalibrationEstimate, Estimate
from sigmaslam.slam.frame_history import FrameHistory
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.tracker import StereoTracker, TrackerConfig
from sigmaslam_evaluation.metrics.trajectory_errors import (
    absolute_trajectory_error,
    is_regular,
    pose_nees,
    relative_pose_error,
)
from tests.support.dense_window import NO_WALK, make_window
from tests.support.simulated_frontend import SCALES, Scale, SimulatedFrontend, frame_of, run_simulated

# ---- simulated runs


@dataclass(frozen=True)
class Errors:
    """Of a trajectory.

    Attributes:
        ate: of positions after the best alignment, metres.
        rpe: of the motion from frame to frame, metres.
        nees: mean per degree of freedom.
    """

    ate: float
    rpe: float
    nees: float


def errors_of(trajectory: Trajectory, covariances: np.ndarray, truth: np.ndarray) -> Errors:
    true = Trajectory(trajectory.timestamps, truth[: len(trajectory)])
    return Errors(
        absolute_trajectory_error(trajectory, true).rmse,
        relative_pose_error(trajectory, true).translation_rmse,
        pose_nees(trajectory, true, covariances).mean,
    )


def live_and_final(frontend: SimulatedFrontend, scale: Scale, config: TrackerConfig | None = None) -> list[Errors]:
    """Of what is said at once, and of what is known in the end."""
    tracker = StereoTracker(frontend.camera, frontend, config=config)
    run = run_simulated(tracker, frontend, scale)
    final, covariances = tracker.final_trajectory()
    assert final.timestamps.tolist() == [estimate.timestamp for estimate in run.estimates]
    live = Trajectory(final.timestamps, np.array([estimate.T_world_camera for estimate in run.estimates]))
    said = np.array([estimate.covariance for estimate in run.estimates])
    kept = tracker.pack_keyframes()
    count = len(kept["keyframe_covariance"]) // 6  # others hang at these
    poses = kept["keyframe_poses"][:count]
    rows = np.searchsorted(final.timestamps, kept["keyframe_timestamps"][:count])
    # The camera is rectified already: the window's frame is the left camera's.
    np.testing.assert_allclose(final.poses[rows], poses, atol=1e-9)
    whole = published_state(tracker._window).all_poses.whole_covariance
    inside = np.array([whole[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])
    there = turn_covariance(se3_inverse(poses), inside)
    # A map leaves what neighbours share to the run that reads it.
    assert np.trace(kept["keyframe_covariance"]) <= np.trace(whole) * (1.0 + 1e-5)
    np.testing.assert_allclose(covariances[rows], there, atol=1e-5 * np.abs(there).max())
    assert is_regular(covariances[1:]).all()
    return [errors_of(live, said, frontend.poses), errors_of(final, covariances, frontend.poses)]


@pytest.mark.long
@pytest.mark.parametrize("kind", SCALES)
def test_without_a_loop_the_end_knows_better_than_each_frame_did(kind: str, monkeypatch: pytest.MonkeyPatch):
    """Each with its own disparity offset; steps of poses that stand on one are better still."""
    monkeypatch.setattr(HeldOffset, "place", lambda self, pose, *_: (pose, np.zeros((6, 6))))
    runs = [live_and_final(SimulatedFrontend(SCALES[kind], seed, 45, offset=0.3), SCALES[kind]) for seed in range(2)]
    live, final = ([run[k] for run in runs] for k in range(2))
    assert np.mean([each.ate for each in final]) < np.mean([each.ate for each in live])
    assert np.mean([each.rpe for each in final]) < 0.95 * np.mean([each.rpe for each in live])
    assert 0.4 < np.mean([each.nees for each in final]) < 2.0


class ThereAndBack(SimulatedFrontend):
    """A drive with a second turn onto its own way: a circle of 80 m, and 30 m on."""

    def __init__(self, seed: int) -> None:
        super().__init__(SCALES["driving"], seed, 110, 100, offset=0.3)

    def _path(self, frames: int) -> np.ndarray:
        step = np.array([0, 0, 1.0, 0, 2 * np.pi / 80, 0])
        return np.array([se3_exp(k * step) for k in range(frames)])


@pytest.mark.long
@pytest.mark.parametrize("max_keyframes", [60, 12], ids=["all remembered", "most forgotten"])
def test_a_loop_corrects_the_frames_of_the_way_round(max_keyframes: int):
    config = TrackerConfig(max_keyframes=max_keyframes)
    runs = [live_and_final(ThereAndBack(seed), SCALES["driving"], config) for seed in range(1)]
    live, final = ([run[k] for run in runs] for k in range(2))
    assert np.mean([each.ate for each in final]) < 0.9 * np.mean([each.ate for each in live])
    assert np.mean([each.rpe for each in final]) < np.mean([each.rpe for each in live])
    assert 0.3 < np.mean([each.nees for each in final]) < 2.5


class Blinded(SimulatedFrontend):
    """Sees nothing in some frames."""

    blind = range(30, 34)

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        view = super().observe(left, right)
        return view.only(np.zeros(len(view.disparity), bool)) if frame_of(left) in self.blind else view

    def match(self, search, view):  # type: ignore[no-untyped-def]
        found = super().match(search, view)
        return found.select(np.zeros(0, np.int64)) if frame_of(view.left) in self.blind else found


@pytest.mark.long
def test_lost_frames_lie_between_those_before_and_after():
    scale = SCALES["drone"]
    frontend = Blinded(scale, 0, 50, offset=0.3)
    tracker = StereoTracker(frontend.camera, frontend)
    run = run_simulated(tracker, frontend, scale)
    rows = np.array(Blinded.blind)
    assert [run.estimates[k].status for k in rows] == ["lost"] * len(rows)
    final, covariances = tracker.final_trajectory()
    live = np.array([run.estimates[k].T_world_camera for k in rows])
    truth = frontend.poses[rows]
    away, away_live = (np.linalg.norm((poses - truth)[:, :3, 3], axis=1).max() for poses in (final.poses[rows], live))
    assert away < 0.5 * away_live
    errors = se3_log(se3_inverse(final.poses[rows]) @ truth)
    squared = [error @ np.linalg.solve(P, error) for error, P in zip(errors, covariances[rows], strict=True)]
    assert np.max(squared) < 22.5  # 99.9 % of six degrees of freedom


# ---- keyframes that come and go

STEP = se3_exp(np.array([0.02, 0.0, 1.0, 0.01, 0.05, -0.02]))
SPREAD = np.diag(np.array([1e-2, 2e-2, 3e-2, 1e-3, 2e-3, 1e-3]) ** 2)
EMPTY = np.zeros((8, 8), np.uint8)


class Walk:
    """A history of frames, every third of which is a keyframe; steps from keyframe to keyframe are independent.

    Args:
        max_keyframes: as of `Keyframes`.
    """

    def __init__(self, max_keyframes: int) -> None:
        self.window = make_window(np.zeros(3))
        self.keyframes = Keyframes(self.window, max_keyframes, 100)
        self.history = FrameHistory(self.window, self.keyframes, np.eye(4))
        self.count = 0

    def add(self) -> None:
        """The next frame."""
        part = self.count % 3 or 3
        step = se3_exp(part / 3 * se3_log(STEP))
        covariance = np.zeros((12, 12))
        covariance[:6, :6], covariance[6:, 6:] = part / 3 * SPREAD, 1e-6 * np.eye(6)
        state = MotionState(step, np.zeros(6), covariance)
        predicted = MotionState(step, np.zeros(6), 100 * covariance)
        if self.count % 3 == 0:
            self._insert_keyframe()
        self.history.append(estimate_at(float(self.count)), predicted, state)
        self.count += 1

    def _insert_keyframe(self) -> None:
        window = self.window
        if len(window) == 2:
            self.keyframes.marginalise_oldest()
        last = window.posterior.poses[-1] if len(window) else np.eye(4)
        step = STEP if len(window) else np.eye(4)
        spread = turn_covariance(last, SPREAD) if len(window) else np.zeros((6, 6))
        window.add_keyframe(last @ step, step, spread, NO_WALK, 1.0)
        self.keyframes.append(empty_view(), float(self.count))


def estimate_at(timestamp: float) -> Estimate:
    """Of an unknown pose."""
    return Estimate(
        timestamp, np.eye(4), np.eye(6), np.eye(6), "lost", 0.0, 0, 0, 0.0, 0, CalibrationEstimate(0.0, 0.0)
    )


def empty_view() -> StereoView:
    """Without features."""
    frontend = SimulatedFrontend(SCALES["drone"], 0, 2)
    view = frontend.observe(frontend.images(0), frontend.images(0))
    return view.only(np.zeros(len(view.disparity), bool))


def walked(max_keyframes: int, frames: int) -> Walk:
    walk = Walk(max_keyframes)
    for _ in range(frames):
        walk.add()
    return walk


def test_forgetting_a_keyframe_leaves_its_frames_where_they_are():
    """Pose and covariance are those of a history that remembers all: the hand-over is exact for independent steps."""
    full, thinned = walked(60, 40), walked(4, 40)
    assert len(full.keyframes.remembered) > 2 * len(thinned.keyframes.remembered)
    (all_poses, all_spread), (poses, spread) = full.history.final(), thinned.history.final()
    np.testing.assert_allclose(poses.poses, all_poses.poses, atol=1e-9)
    np.testing.assert_allclose(spread, all_spread, atol=2e-6 * np.abs(all_spread).max())
    np.testing.assert_allclose(poses.poses[::3, :, :], [np.linalg.matrix_power(STEP, k) for k in range(14)], atol=1e-9)


def test_frames_of_forgotten_keyframes_move_with_a_loop():
    """As those of a history that remembers all, after the last keyframe is measured from the first."""
    full, thinned = walked(60, 40), walked(4, 40)
    for walk in (full, thinned):
        state = walk.window.posterior
        measured = se3_inverse(state.past.poses[0]) @ se3_exp(np.array([0.05, 0.02, -0.03, 1e-3, -2e-3, 1e-3]))
        assert walk.window.add_loop_constraint(0, measured @ state.poses[-1], 1e-6 * np.eye(6))
    for walk in (full, thinned):
        walk.add()
    (all_poses, all_spread), (poses, spread) = full.history.final(), thinned.history.final()
    moved = np.linalg.norm(
        se3_log(se3_inverse(poses.poses[::3]) @ [np.linalg.matrix_power(STEP, k) for k in range(14)])
    )
    assert moved > 0.05
    np.testing.assert_allclose(poses.poses, all_poses.poses, atol=0.02 * moved)
    np.testing.assert_allclose(spread, all_spread, atol=0.02 * np.abs(all_spread).max())


def test_the_first_keyframe_can_be_forgotten_too():
    """Of a run in a map the first keyframe may be superfluous: its frames hang at another one."""
    walk = walked(60, 20)
    before, spread_before = walk.history.final()
    walk.keyframes.remembered.pop(0)
    walk.window.forget_past(0)
    walk.add()
    after, spread = walk.history.final()
    np.testing.assert_allclose(after.poses[:20], before.poses, atol=1e-9)
    # The first one was the world; that the others are known relative to it is known no longer.
    difference = np.linalg.eigvalsh((spread[:20] - spread_before)[:18])  # the rest is smoothed with the new frame
    assert difference.min() > -1e-6 * np.abs(spread).max()


def test_a_restart_leaves_what_was_before_as_it_was():
    walk = walked(60, 20)
    before, spread_before = walk.history.final()
    walk.keyframes.restart()
    walk.count = 21
    for _ in range(10):
        walk.add()
    after, spread = walk.history.final()
    assert after.timestamps.tolist() == [*range(20), *range(21, 31)]
    np.testing.assert_array_equal(after.poses[:20], before.poses)
    np.testing.assert_array_equal(spread[:20], spread_before)
    np.testing.assert_allclose(after.poses[20], np.eye(4), atol=1e-12)


def test_a_frame_without_a_pose_is_not_in_the_trajectory():
    walk = Walk(60)
    nowhere = replace(estimate_at(-1.0), T_world_camera=np.full((4, 4), np.nan))
    walk.history.append(nowhere, *[MotionState(np.eye(4), np.zeros(6), np.zeros((12, 12)))] * 2)
    walk.add()
    poses, spread = walk.history.final()
    assert poses.timestamps.tolist() == [0.0]
    np.testing.assert_array_equal(poses.poses, [np.eye(4)])
    np.testing.assert_array_equal(spread, [np.zeros((6, 6))])


def test_the_frame_of_a_keyframe_has_its_covariance():
    walk = walked(60, 7)
    state = walk.window.posterior
    _, spread = walk.history.final()
    last = pose_slice(len(state) - 1)
    expected = turn_covariance(se3_inverse(state.poses[-1]), state.covariance[last, last])
    np.testing.assert_allclose(spread[6], expected, atol=1e-9)


@pytest.mark.long
def test_a_history_takes_few_bytes_a_frame():
    walk = walked(4, 200)
    frames = [interval.frames for interval in walk.history._intervals]
    held = sum(column.nbytes for part in frames for column in part.columns())
    assert held / sum(map(len, frames)) < 500
    assert len(frames) < 10

"""A lap that ends where it began, by the tracker without images: what its loop gains on the way round."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sigmaslam.estimation.calibration_errors import ERRORS, CalibrationPrior
from sigmaslam.estimation.estimator_graphs import EstimatorGraphs
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.frontend.types import KeypointSearch, StereoView, TemporalMatches
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.slam import loop_closure
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.loop_closure import LoopCloser
from sigmaslam.slam.relative_poses import SPANS
from sigmaslam.slam.tracker import StereoTracker
from sigmaslam.two_view.stereo_pose import RelativePose
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error
from tests.support.quantiles import chi_square_median, squared_sigmas
from tests.support.simulated_frontend import SCALES, SimulatedFrontend, SimulatedRun, frame_of, run_simulated

CAMERA = RectifiedStereo(450.0, 450.0, 376.0, 240.0, 0.11, 752, 480)
LAP, FRAMES = 180, 220
SCALE = SCALES["driving"]
OFFSET = 0.3
# Frames after which a keyframe is one of long ago.
LONG_AGO = 20
# Frames after which none is in the window.
OUTSIDE = 60


class LapFrontend(SimulatedFrontend):
    """A drive around a circle of 180 m, and on for 40 m.

    Args:
        seed: of everything random.
        loops: what matches say of keyframes of long ago: "right", "none", or "wrong": as if the camera were 5 m aside.
        drift: by which places are off to the right for every frame since the keyframe, and nobody knows, pixels.
    """

    def __init__(self, seed: int, loops: str = "right", drift: float = 0.0) -> None:
        super().__init__(SCALE, seed, FRAMES, 100, offset=OFFSET)
        self._loops, self._drift = loops, drift

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        # Drawn whatever is made of it, so that the noise is that of the other runs.
        found = super().match(search, view)
        frame = frame_of(view.left)
        since = frame - self.frame_of_key(search.key)
        if since < LONG_AGO:
            found.points[:, 0] += self._drift * since
        if self._loops == "right" or since < (LONG_AGO if search.covariance is None else OUTSIDE):
            return found
        if self._loops == "none":
            return found.select(np.zeros(0, np.int64))
        points = self._seen[self.frame_of_key(search.key)][found.key_index]
        aside = self.poses[frame] @ se3_exp(np.array([5.0, 0, 0, 0, 0, 0]))
        seen = self._project_from(aside)[0][points]
        return replace(found, points=seen[:, :2], disparity=seen[:, 2])

    def _path(self, frames: int) -> np.ndarray:
        step, poses = se3_exp(np.array([0, 0, 1.0, 0, 2 * np.pi / LAP, 0])), [np.eye(4)]
        for _ in range(frames - 1):
            poses.append(nearest_rigid(poses[-1] @ step))
        return np.array(poses)


@dataclass(frozen=True)
class Lap:
    """Errors after a lap, of keyframes and points of its middle (metres, and NEES per degree of freedom), and after it.

    Attributes:
        keyframe_error, keyframe_nees: means.
        point_error, point_nees: medians, the latter over what it should be.
        end_error: metres, mean of the frames after the lap.
        relative_error, relative_nees: of frames after the lap relative to keyframes 100 m back, means; metres.
        reported_error: the same of the poses that were reported at the time of both.
        poses: (K, 4, 4) remembered.
    """

    keyframe_error: float
    keyframe_nees: float
    point_error: float
    point_nees: float
    end_error: float
    relative_error: float
    relative_nees: float
    reported_error: float
    poses: np.ndarray


def drive(seed: int, loops: str = "right") -> Lap:
    """Around once."""
    frontend = LapFrontend(seed, loops)
    tracker = StereoTracker(frontend.camera, frontend)
    run = run_simulated(tracker, frontend, SCALE)
    assert [e.status for e in run.estimates[1:]] == ["tracking"] * (FRAMES - 1)
    kept = tracker.pack_keyframes()
    joint = kept["keyframe_covariance"]
    count = len(joint) // 6  # others hang at these
    number = np.round(kept["keyframe_timestamps"][:count] / SCALE.interval).astype(int)
    poses = kept["keyframe_poses"][:count]
    middle = (number >= 40) & (number < 140)
    true = frontend.poses[number]
    away = np.linalg.norm(true[:, :3, 3] - poses[:, :3, 3], axis=1)
    errors = se3_log(true @ se3_inverse(poses))
    covariances = [joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(number))]
    nees = [e @ np.linalg.lstsq(P, e, rcond=1e-12)[0] / 6 for e, P in zip(errors, covariances, strict=True)]
    point_error, point_nees = _points(tracker, frontend)
    end = [
        np.linalg.norm(e.T_world_camera[:3, 3] - T[:3, 3])
        for e, T in zip(run.estimates[LAP + 20 :], frontend.poses[LAP + 20 :], strict=True)
    ]
    return Lap(
        float(np.mean(away[middle])),
        float(np.mean(np.array(nees)[middle])),
        point_error,
        point_nees,
        float(np.mean(end)),
        *_relative_to_the_lap(run),
        poses,
    )


def _relative_to_the_lap(run: SimulatedRun) -> tuple[float, float, float]:
    """Mean error and NEES of relative poses after the lap, and error of what had been reported."""
    error, nees, reported = [], [], []
    for now in range(LAP + 20, FRAMES):
        relative = run.estimates[now].relative_poses
        for row in np.flatnonzero(relative.span == SPANS.index("100 m")):
            frame = round(relative.timestamp[row] / SCALE.interval)
            true = se3_inverse(run.poses[frame]) @ run.poses[now]
            off = se3_log(se3_inverse(relative.pose[row]) @ true)
            before = se3_inverse(run.estimates[frame].T_world_camera) @ run.estimates[now].T_world_camera
            error.append(np.linalg.norm(off[:3]))
            nees.append(squared_sigmas(off, relative.covariance[row]) / 6)
            reported.append(np.linalg.norm(before[:3, 3] - true[:3, 3]))
    return float(np.mean(error)), float(np.mean(nees)), float(np.mean(reported))


def _points(tracker: StereoTracker, frontend: LapFrontend) -> tuple[float, float]:
    """Median error and NEES of the map's points that were first seen in the middle of the lap."""
    found = tracker.map()
    number = np.round(found.timestamps / SCALE.interval).astype(int)
    error, nees = [], []
    for k in np.unique(number[(number >= 40) & (number < 140)]):
        own = number == k
        truth, visible = frontend._project(k)
        apart = np.linalg.norm(truth[None, :, :2] - found.pixels[own][:, None], axis=2)
        apart[:, ~visible] = np.inf
        off = found.points[own] - frontend._points[apart.argmin(axis=1)]
        sure = apart.min(axis=1) < 1.5  # pixels, the keypoint's noise is 0.25: no other point was meant
        error += np.linalg.norm(off[sure], axis=1).tolist()
        nees += (squared_sigmas(off[sure], found.covariances[own][sure]) / 3).tolist()
    assert len(error) > 100
    # A right NEES has the median of chi-square; of a few points another one was meant.
    return float(np.median(error)), float(np.median(nees)) * 3 / chi_square_median(3)


@pytest.mark.slow
def test_a_loop_corrects_keyframes_and_points_of_the_way_round(monkeypatch: pytest.MonkeyPatch):
    """Without any extra; halfway round a loop takes half of the variance, at the end nearly all of it."""
    monkeypatch.setitem(sys.modules, "gtsam", None)
    before = [drive(seed, "none") for seed in range(20)]
    after = [drive(seed) for seed in range(20)]

    def factor(name: str) -> float:
        return float(
            np.sqrt(np.mean([getattr(b, name) ** 2 for b in before]) / np.mean([getattr(a, name) ** 2 for a in after]))
        )

    # Where half of the way is gone, a random walk is left with 1 / sqrt(2) of its error.
    assert factor("keyframe_error") > 1.15
    assert factor("point_error") > 1.15
    assert factor("end_error") > 2.0
    # Twenty laps, each with errors that all its keyframes share: the mean scatters by a sixth.
    assert 0.4 < np.mean([lap.keyframe_nees for lap in after]) < 2.0
    assert 0.4 < np.mean([lap.point_nees for lap in after]) < 2.0
    assert 0.4 < np.mean([lap.relative_nees for lap in after]) < 2.0
    # The keyframe's pose is the corrected one, not what was reported before the loop.
    assert np.mean([lap.relative_error for lap in after]) < 0.9 * np.mean([lap.reported_error for lap in after])


@pytest.mark.slow
def test_wrong_loops_spoil_nothing():
    without, misled = drive(0, "none"), drive(0, "wrong")
    np.testing.assert_array_equal(misled.poses, without.poses)
    assert misled.end_error == without.end_error


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_two_loops_that_agree_outweigh_a_covariance_that_is_too_small(seed: int):
    """The first contradicts it and is refused; at the second, the poses are moved, and less certain than they were."""
    frontend = LapFrontend(seed, drift=0.06)
    run = run_simulated(StereoTracker(frontend.camera, frontend), frontend, SCALE)
    assert [e.status for e in run.estimates[1:]] == ["tracking"] * (FRAMES - 1)

    def judge(frame: int) -> tuple[float, float]:
        error = se3_log(se3_inverse(run.estimates[frame].T_world_camera) @ frontend.poses[frame])
        return float(np.linalg.norm(error[:3])), squared_sigmas(error, run.estimates[frame].covariance) / 6

    closed = [k for k, e in enumerate(run.estimates) if e.loop is not None]
    (off, surprise), (left, then) = judge(closed[0] - 1), judge(closed[0] + 1)
    assert surprise > 5.0
    assert left < 0.2 * off
    assert then < 3.0


@pytest.mark.slow
def test_a_closed_loop_is_not_taken_for_a_wrong_calibration(real_data: Path):
    """Poses jump with the loop; where those of the evidence stay, an offset of 3.6 px is believed from frame 32 on."""
    folder = real_data / "euroc_v1_01_keyframes_a"
    sequence = open_sequence(folder)
    tracker = StereoTracker(sequence.camera)
    estimates = [tracker.step(each.left, each.right, each.timestamp) for each in sequence.frames()]
    assert sum(each.loop is not None for each in estimates) > 5
    assert not any(Doubt.OFFSET in each.doubts for each in estimates)
    # The lens is, before any loop; and loops hardly move it.
    causes = {name: cause for name, cause in tracker._window.evidence.weigh().items() if cause.probability > 0.5}
    first = next(k for k, each in enumerate(estimates) if each.loop is not None)
    assert causes.keys() == estimates[first - 1].calibration.causes.keys() <= {"lens"}
    _, before, sigma = estimates[first - 1].calibration.causes["lens"]
    assert abs(causes["lens"].mean / sequence.camera.left.fx - before) < 2.0 * sigma
    found = [each for each in estimates if each.has_pose]
    path = Trajectory(np.array([each.timestamp for each in found]), np.array([each.T_world_camera for each in found]))
    truth = read_trajectory(folder / "groundtruth.csv")
    assert absolute_trajectory_error(path, truth).rmse < 0.04


def test_loops_are_sought_as_far_as_a_bad_calibration_makes_the_place_uncertain(monkeypatch: pytest.MonkeyPatch):
    """A keyframe beyond three standard deviations by the sigmas as they are, and within them by larger ones."""
    prior = CalibrationPrior.of(CAMERA, CalibrationSigmas(), 0.5)
    window = KeyframeWindow(CAMERA, prior, EstimatorGraphs(CAMERA, "onnx", unscented=True))
    window.add_keyframe(np.eye(4), np.eye(4), np.eye(6) * 1e-4, np.zeros(len(ERRORS)), depth=1.0)
    common = window.posterior.common.copy()
    common[-6, ERRORS.index("yaw")] = 1.0
    window.posterior = replace(window.posterior, common=common)
    old = SimpleNamespace(id=0, timestamp=0.0)
    newest = SimpleNamespace(id=50, timestamp=9.0, view=None)
    away = se3_exp(np.array([6.0, 0, 0, 0, 0, 0]))
    keyframes = SimpleNamespace(left_long_ago=lambda _=0: [old], poses=lambda _: away[None], appearance=None)
    monkeypatch.setattr(loop_closure, "count_votes", lambda _, asked: np.ones(len(asked)))
    monkeypatch.setattr(loop_closure, "most_alike", lambda _, asked, __: asked)
    found = []
    for window.worse in (1.0, 3.0):
        found.append(LoopCloser(window, keyframes, None)._revisited(newest)[0])
    assert found == [None, old]


@pytest.mark.parametrize(("away", "is_closed"), [(0.9, True), (1.1, False)])
def test_no_loop_is_closed_across_more_than_the_depth_of_the_scene(
    monkeypatch: pytest.MonkeyPatch, away: float, is_closed: bool
):
    """Errors of the calibration would move the far keyframe by more than the matches tell."""
    seen = RelativePose(se3_exp(np.array([0, 0, away, 0, 0, 0])), np.ones(9, bool), np.eye(6) * 1e-4, 1.0)
    state = SimpleNamespace(past=SimpleNamespace(poses=np.eye(4)[None]), poses=seen.T_key_camera[None])
    window = SimpleNamespace(posterior=state, depth=1.0, add_loop_constraint=lambda *loop: True)
    old = SimpleNamespace(id=0, timestamp=3.0, view=None, origin=0)
    keyframes = SimpleNamespace(active=[SimpleNamespace(timestamp=9.0, view=None)], index=lambda id: id)
    closer = LoopCloser(window, keyframes, SimpleNamespace(confirmed_pose_to=lambda key, view: seen))
    monkeypatch.setattr(LoopCloser, "_revisited", lambda self, newest: (old, 0.0))
    monkeypatch.setattr(loop_closure, "from_origin", lambda keyframe, relative: relative)
    assert (closer.close() == 3.0) == is_closed

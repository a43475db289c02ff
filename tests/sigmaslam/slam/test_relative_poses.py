"""Poses relative to earlier keyframes, by the tracker on points with exactly the errors that are claimed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.slam.relative_poses import DISTANCES, DURATIONS, SPANS, RelativePoses
from sigmaslam.slam.scrutiny import Scrutiny
from sigmaslam.slam.tracker import StereoTracker
from tests.support.quantiles import squared_sigmas
from tests.support.simulated_frontend import SCALES, SimulatedFrontend, SimulatedRun, run_simulated


class BlindFrontend(SimulatedFrontend):
    """Sees nothing in the last frame."""

    def _project(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        places, visible = super()._project(frame)
        return places, visible & (frame < len(self.poses) - 1)


@cache
def simulate(kind: str, seed: int, frames: int) -> SimulatedRun:
    scale = SCALES[kind]
    frontend = SimulatedFrontend(scale, seed, frames, 100)
    return run_simulated(StereoTracker(frontend.camera, frontend), frontend, scale)


def earlier_frames(relative: RelativePoses, interval: float) -> np.ndarray:
    return np.round(relative.timestamp / interval).astype(int)


def nees_by_span(run: SimulatedRun, interval: float) -> dict[str, list[float]]:
    """Per degree of freedom, of all frames."""
    nees: dict[str, list[float]] = {}
    for truth, estimate in zip(run.poses, run.estimates, strict=True):
        relative = estimate.relative_poses
        true = se3_inverse(run.poses[earlier_frames(relative, interval)]) @ truth
        squared = squared_sigmas(se3_log(se3_inverse(relative.pose) @ true), relative.covariance)
        for span, value in zip(relative.span, squared, strict=True):
            nees.setdefault(SPANS[span], []).append(value / 6)
    return nees


@pytest.mark.long
@pytest.mark.parametrize(("kind", "spans"), [("driving", ("10 m", "1 s")), ("drone", ("1 m", "1 s"))])
def test_errors_are_as_large_as_the_relative_covariance_says(
    kind: str, spans: tuple[str, str], monkeypatch: pytest.MonkeyPatch
):
    # These worlds have no errors of following that look like those of a pair.
    monkeypatch.setattr("sigmaslam.estimation.calibration_errors._LEAST_SHARE", 0.0)
    nees: dict[str, list[float]] = {}
    for seed in range(8):
        for span, values in nees_by_span(simulate(kind, seed, 50), SCALES[kind].interval).items():
            nees.setdefault(span, []).append(float(np.mean(values)))
    for span in spans:
        assert len(nees[span]) == 8
        assert 0.7 < np.mean(nees[span]) < 1.3, (span, nees[span])


@pytest.mark.long
def test_rows_are_of_keyframes_about_as_far_back_as_the_span_says():
    run = simulate("driving", 1, 120)
    interval = SCALES["driving"].interval
    places = np.array([estimate.T_world_camera[:3, 3] for estimate in run.estimates])
    lengths = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))]
    keyframes = {k for k, estimate in enumerate(run.estimates) if estimate.tracks is not None}
    seen = set()
    for now, estimate in enumerate(run.estimates):
        relative = estimate.relative_poses
        earlier = earlier_frames(relative, interval)
        assert set(earlier.tolist()) <= keyframes
        assert len(set(relative.span.tolist())) == len(relative)
        for span, frame, pose in zip(relative.span, earlier, relative.pose, strict=True):
            seen.add(SPANS[span])
            back = lengths[now] - lengths[frame] if span < len(DISTANCES) else (now - frame) * interval
            nominal = (*DISTANCES, *DURATIONS)[span]
            # The path is measured from keyframe to keyframe, which cuts its corners.
            assert 0.7 < back / nominal < 1.45
            assert np.linalg.norm(pose[:3, 3]) == pytest.approx(np.linalg.norm(places[now] - places[frame]), rel=0.05)
    assert seen == {"1 m", "10 m", "50 m", "100 m", "1 s", "5 s"}


@pytest.mark.long
def test_covariances_are_symmetric_and_sharper_than_those_of_absolute_poses():
    """Errors of before the earlier keyframe are not in them."""
    run = simulate("driving", 1, 120)
    last = run.estimates[-1]
    for estimate in run.estimates:
        covariance = estimate.relative_poses.covariance
        np.testing.assert_array_equal(covariance, covariance.transpose(0, 2, 1))
        assert (np.linalg.eigvalsh(covariance) > 0).all()
    short = last.relative_poses.span == SPANS.index("1 s")
    assert np.trace(last.relative_poses.covariance[short][0][:3, :3]) < 0.1 * np.trace(last.covariance[:3, :3])


@pytest.mark.long
def test_a_lost_frame_is_related_with_the_uncertainty_of_its_prediction():
    scale = SCALES["drone"]
    frontend = BlindFrontend(scale, 0, 41, 100)
    *estimates, lost = run_simulated(StereoTracker(frontend.camera, frontend), frontend, scale).estimates
    assert lost.status == "lost"
    before, after = estimates[-1].relative_poses, lost.relative_poses
    common = np.intersect1d(before.span, after.span)
    assert len(common)
    for span in common:
        sharp, vague = (np.trace(each.covariance[each.span == span][0][:3, :3]) for each in (before, after))
        assert vague > sharp


@pytest.mark.long
def test_what_may_have_drawn_a_pose_is_in_it_at_keyframes_too(monkeypatch: pytest.MonkeyPatch):
    spread, doubt = 0.5**2 * np.eye(6), Scrutiny.doubt

    def doubt_last(self, frame, matches, fit):
        matches, fit, doubts = doubt(self, frame, matches, fit)
        doubts.add_motion(fit.pose, fit.pose, spread)
        return matches, fit, doubts

    sure = simulate("driving", 0, 60)
    monkeypatch.setattr(Scrutiny, "doubt", doubt_last)
    frontend = SimulatedFrontend(SCALES["driving"], 0, 60, 100)
    run = run_simulated(StereoTracker(frontend.camera, frontend), frontend, SCALES["driving"])
    seen = {True: 0, False: 0}
    for plain, doubted in zip(sure.estimates, run.estimates, strict=True):
        for covariance in doubted.relative_poses.covariance:
            assert np.linalg.eigvalsh(covariance)[-1] > 0.5**2
            seen[doubted.tracks is not None] += 1
        assert all(np.linalg.eigvalsh(each)[-1] < 0.4**2 for each in plain.relative_poses.covariance)
    assert seen[True] > 1
    assert seen[False] > 20


def test_before_there_is_a_keyframe_there_is_nothing():
    assert len(simulate("drone", 0, 1).estimates[0].relative_poses) == 0

"""By how much a prediction is off, as optical flow tells before anything is gated."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.frontend.types import KeypointSearch, StereoView, TemporalMatches
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.slam import guided_matching, landmark_following
from sigmaslam.slam.guided_matching import _excess
from sigmaslam.slam.tracker import Estimate, StereoTracker
from tests.support.estimates import squared_error, statuses
from tests.support.quantiles import WITHIN_3_SIGMA, chi_square_quantile, squared_sigmas
from tests.support.simulated_frontend import SCALES, SimulatedFrontend, run_simulated
from tests.support.simulated_stereo import frame_of

SCALE = SCALES["drone"]
ELLIPSE = chi_square_quantile(0.99, 2)
ROOT = np.array([[2.0, 0.0], [0.7, 0.5]])


# ---- of departures


def departures(count: int, scale: float = 1.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """So many times as large as their covariances say."""
    size = np.random.default_rng(seed).uniform(0.5, 2.0, count)[:, None]
    normal = np.random.default_rng(seed + 1).standard_normal((count, 2))
    return scale * size * normal @ ROOT.T, size[:, :, None] ** 2 * (ROOT @ ROOT.T)


@pytest.mark.parametrize("scale", [1.5, 4.0, 20.0])
def test_departures_are_too_large_by_the_square_of_their_scale(scale: float):
    found = [_excess(*departures(2000, scale, seed)) for seed in range(20)]
    # The quantile of two thousand scatters by 5 %.
    assert np.mean(found) == pytest.approx(scale**2, rel=0.05)


def test_a_prediction_that_holds_is_never_called_better_than_it_is():
    assert _excess(*departures(500, 0.5)) == 1.0
    departure, covariance = departures(500)
    assert _excess(0.0 * departure, covariance) == 1.0


@pytest.mark.parametrize("ratio", [0.5, 2.0, 9.0])
def test_a_known_departure_of_all_has_a_known_excess(ratio: float):
    """All on the ellipse that holds 30 % of a Gaussian, or on one so many times as large."""
    angle = np.linspace(0.0, 2.0 * np.pi, 50)
    on_circle = np.sqrt(ratio * chi_square_quantile(0.3, 2)) * np.column_stack([np.cos(angle), np.sin(angle)])
    covariance = np.tile(ROOT @ ROOT.T, (50, 1, 1))
    assert _excess(on_circle @ ROOT.T, covariance) == pytest.approx(max(ratio, 1.0))


def test_landmarks_that_flow_did_not_take_say_nothing():
    departure, covariance = departures(200, 5.0)
    lost = np.arange(200) % 3 == 0
    expected = _excess(departure[~lost], covariance[~lost])
    departure[lost] = np.nan
    assert _excess(departure, covariance) == expected > 10.0


def test_a_few_landmarks_are_no_evidence():
    departure, covariance = departures(20, 10.0)
    departure[7:] = np.nan
    assert _excess(departure, covariance) == 1.0
    departure[7] = departure[0]
    assert _excess(departure, covariance) > 10.0


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_what_moves_on_its_own_is_not_followed_however_far_it_goes(share: float):
    """Of the others, which are where they should be, the 30 % of all are the nearest: a finite quantile."""
    departure, covariance = departures(2000)
    moving = np.arange(2000) < share * 2000
    departure[moving] += 1000.0
    most = chi_square_quantile(0.3 / (1.0 - share), 2) / chi_square_quantile(0.3, 2)
    assert _excess(departure, covariance) == pytest.approx(most, rel=0.1)


# ---- of a tracker


class FlowingFrontend(SimulatedFrontend):
    """Searches within ellipses alone where there are any, as front ends do; images flow as the points do.

    Args:
        seed, frames: as of any.
        turns: radians that the camera turns to the right from each frame to the next.
        blurred: frames whose features match nothing: they can be followed, but not recognised.
        moving: share of the points that move aside from `begins` on, by 0.15 m a frame.
    """

    def __init__(
        self,
        seed: int,
        frames: int,
        turns: np.ndarray | None = None,
        blurred: range = range(0),
        moving: float = 0.0,
        begins: int = 0,
    ) -> None:
        self._turns, self.blurred, self._begins = turns, blurred, begins
        super().__init__(SCALE, seed, frames, offset=0.0)
        self._is_moving = np.random.default_rng(seed).random(len(self._points)) < moving

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        found = self._match_within(search, view)
        return found.select(np.zeros(0, np.int64)) if frame_of(view.left) in self.blurred else found

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        view = self.observe(left, right)
        return [self._match_within(search, view) for search in searches]

    def flow(
        self, left0: np.ndarray, left1: np.ndarray, points0: np.ndarray, guess1: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """In place of `follow_flow`: where the nearest point of the world goes."""
        before, visible = self._project(frame_of(left0))
        candidates = np.flatnonzero(visible)
        apart = np.linalg.norm(points0[:, None] - before[candidates, :2], axis=2)
        nearest = candidates[apart.argmin(axis=1)]
        after, visible = self._project(frame_of(left1))
        return after[nearest, :2], visible[nearest] & (apart.min(axis=1) < 1.0)

    def _match_within(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        found = super().match(search, view)
        if search.covariance is None:
            return found
        at = np.searchsorted(search.index, found.key_index)
        apart = squared_sigmas(found.points - search.predicted[at], search.covariance[at])
        return found.select(np.flatnonzero(apart < ELLIPSE))

    def _path(self, frames: int) -> np.ndarray:
        if self._turns is None:
            return super()._path(frames)
        poses = [np.eye(4)]
        for turn in self._turns:
            poses.append(poses[-1] @ se3_exp(np.array([0.02, 0.0, 0.03, 0.0, turn, 0.0])))
        return np.array(poses)

    def _project(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        if not frame > self._begins or not self._is_moving.any():
            return super()._project(frame)
        still = self._points
        self._points = still + 0.15 * (frame - self._begins) * self._is_moving[:, None] * np.eye(3)[0]
        places = super()._project(frame)
        self._points = still
        return places


@pytest.fixture
def widened(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """By what predictions were widened."""
    factors: list[float] = []
    widen = MotionFilter.widen
    monkeypatch.setattr(MotionFilter, "widen", lambda motion, factor: (factors.append(factor), widen(motion, factor)))
    return factors


def tracked(frontend: FlowingFrontend, monkeypatch: pytest.MonkeyPatch) -> list[Estimate]:
    monkeypatch.setattr(landmark_following, "follow_flow", frontend.flow)
    return run_simulated(StereoTracker(frontend.camera, frontend, threads=1), frontend, SCALE).estimates


def shaken(seed: int) -> FlowingFrontend:
    """Turns by 9 px a frame, and back at once every few frames; meanwhile features are of no use."""
    turns = 0.02 * np.array([1.0] * 12 + [-1.0] * 5 + [1.0] * 4 + [-1.0] * 6)
    return FlowingFrontend(seed, len(turns) + 1, turns, range(12, 100))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_turns_back_at_once_is_followed(seed: int, monkeypatch: pytest.MonkeyPatch, widened: list[float]):
    frontend = shaken(seed)
    estimates = tracked(frontend, monkeypatch)
    assert statuses(estimates) == ["starting"] + ["tracking"] * (len(estimates) - 1)
    errors = [squared_error(estimate, truth) for estimate, truth in zip(estimates[1:], frontend.poses[1:], strict=True)]
    assert max(errors) < WITHIN_3_SIGMA
    assert len(widened) >= 3
    assert max(widened) > 10.0


def test_without_flow_it_would_be_lost(monkeypatch: pytest.MonkeyPatch):
    """The scene is one that needs it."""
    monkeypatch.setattr(guided_matching, "_excess", lambda departure, covariance: 1.0)
    assert "lost" in statuses(tracked(shaken(0), monkeypatch))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_what_moves_on_its_own_does_not_widen_the_prediction(
    seed: int, monkeypatch: pytest.MonkeyPatch, widened: list[float]
):
    """60 % of the points move aside at once by some 20 px a frame: no more than what the others account for.

    The smallest 30 % of all departures are the smallest 75 % of the others'.
    """
    tracked(FlowingFrontend(seed, 25), monkeypatch)
    still = max(widened, default=1.0)
    widened.clear()
    frontend = FlowingFrontend(seed, 25, moving=0.6, begins=10)
    estimates = tracked(frontend, monkeypatch)
    assert max(widened, default=1.0) < chi_square_quantile(0.75, 2) / chi_square_quantile(0.3, 2) * still
    # More than half of what is seen moves: that may be doubted, but not lost.
    assert statuses(estimates)[0] == "starting"
    assert not {"lost", "relocalised"} & set(statuses(estimates)[1:])
    errors = [squared_error(estimate, truth) for estimate, truth in zip(estimates[1:], frontend.poses[1:], strict=True)]
    assert max(errors) < WITHIN_3_SIGMA

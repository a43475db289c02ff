"""Errors of a calibration that are not estimated: they pass into estimates as `common` says, and explain their errors.

By worlds that are seen by pairs with such errors, and estimated as if they had none.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import astuple, dataclass, fields, replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from sigmaslam.estimation.calibration_errors import ERRORS, SHOWN, CalibrationPrior
from sigmaslam.estimation.calibration_evidence import CalibrationEvidence
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.published_state import published_fit, published_state
from sigmaslam.estimation.relative_covariance import frame_relative_to, last_relative_to
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from tests.support.dense_window import (
    CALIBRATION_SIGMA,
    CAMERA,
    CONSIDERED,
    ESTIMATED,
    KEYFRAMES,
    NARROW,
    STEP_SIGMA,
    World,
    add_keyframe,
    by_pair_with,
    fit,
    in_sigmas,
    make_window,
    unsolved,
    world,
)
from tests.support.quantiles import squared_sigmas

NAMES = ERRORS[CONSIDERED]
COUNT, WORLDS = 60, 40
# With everything so narrow that it is linear.
GIVEN = world(2, NARROW, count=COUNT)
SIGMA = NARROW * np.linspace(1.0, 2.0, len(NAMES))


@dataclass(frozen=True)
class Solution:
    """What is made of a world.

    Attributes:
        window: with all keyframes, or with the last one alone, the others in its past.
        fit: of the frame after it.
    """

    window: KeyframeWindow
    fit: FrameFit


Build = Callable[[World, np.ndarray], Solution]


def whole(given: World, sigma: np.ndarray, linearisation: str = "extended") -> Solution:
    """All keyframes in the window."""
    window = unsolved(given, linearisation, considered_sigma=sigma)
    window.solve(4)
    return Solution(window, fit(window, given))


def moving_on(given: World, sigma: np.ndarray, linearisation: str = "extended") -> Solution:
    """Two keyframes have left, the first one before the last came."""
    window = make_window(CALIBRATION_SIGMA * given.scale, linearisation, considered_sigma=sigma)
    for k in range(KEYFRAMES):
        views = given.views[k]
        if k == KEYFRAMES - 1:
            new_row = window.marginalise_oldest()
            views = views.select(given.host[views.landmark] > 0).renumber(new_row)
        add_keyframe(window, given, k, views)
        window.solve(4)
    window.marginalise_oldest()
    window.solve(4)
    return Solution(window, fit(window, given, views_of_last(given)))


def with_loop(given: World, sigma: np.ndarray, linearisation: str = "extended") -> Solution:
    """The last keyframe has then been measured from the first one."""
    window = moving_on(given, sigma, linearisation).window
    loop_sigma = 0.03 * given.scale * STEP_SIGMA
    # Of each world its own.
    random = np.random.default_rng(np.abs(1e9 * given.poses[-1, :3, 3]).astype(int))
    error = se3_exp(loop_sigma * random.standard_normal(6))
    T = se3_inverse(given.poses[0]) @ error @ given.poses[KEYFRAMES - 1]
    assert window.add_loop_constraint(0, T, np.diag(loop_sigma**2))
    window.solve(4)
    return Solution(window, fit(window, given, views_of_last(given)))


def views_of_last(given: World) -> LandmarkViews:
    """What the frame sees of the last keyframe's landmarks, by their rows where there are no others."""
    views, of_last = given.views[-1], given.host == KEYFRAMES - 1
    return views.select(of_last[views.landmark]).renumber(np.where(of_last, np.cumsum(of_last) - 1, -1))


@pytest.fixture(autouse=True)
def no_error_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """`common` is of errors that nothing tells, and that the window therefore leaves as they are."""
    beside = CalibrationEvidence.beside
    still = np.zeros(CALIBRATION_SIZE)
    monkeypatch.setattr(CalibrationEvidence, "beside", lambda evidence, causes: (still, beside(evidence, causes)[1]))


BUILDS: dict[str, Build] = {"window": whole, "past": moving_on, "loop": with_loop}


# ---- what estimates are off by


@dataclass(frozen=True)
class Slopes:
    """How estimates follow an error.

    Attributes:
        state: (n,) calibration, poses of the past and of the window.
        frame: (n + 6,) as a frame has them: calibration, poses of the window, its own pose.
        last, frame_relative: (M, 6) the last keyframe and the frame, relative to each of the keyframes before it.
    """

    state: np.ndarray
    frame: np.ndarray
    last: np.ndarray
    frame_relative: np.ndarray


def poses_of(solution: Solution) -> dict[str, np.ndarray]:
    """Estimates of poses, by who estimates them."""
    state, joint = solution.window.posterior, solution.fit.joint
    moved = se3_exp(joint.step[CALIBRATION_SIZE:-6].reshape(-1, 6)) @ state.poses
    last, earlier = len(state.past) + len(state) - 1, np.arange(len(state.past) + len(state))
    return {
        "state": np.concatenate([state.past.poses, state.poses]),
        "frame": np.concatenate([moved, solution.fit.pose[None]]),
        "before last": last_relative_to(state, earlier[:last])[0],
        "before frame": frame_relative_to(state, joint, earlier)[0],
    }


@cache
def slopes(build: str, name: str) -> Slopes:
    """By finite differences, of a pair with a little more of the error and one with a little less."""
    size = 1e-3 * NARROW
    error = size * (np.array(ERRORS) == name)
    more, less = (BUILDS[build](by_pair_with(GIVEN, sign * error), SIGMA) for sign in (1.0, -1.0))
    here, there = poses_of(more), poses_of(less)
    by_pose = {key: se3_log(here[key] @ se3_inverse(there[key])) / (2 * size) for key in here}
    calibration, of_frame = (
        (one - other) / (2 * size)
        for one, other in (
            (more.window.posterior.calibration, less.window.posterior.calibration),
            (more.fit.calibration, less.fit.calibration),
        )
    )
    return Slopes(
        np.r_[calibration, by_pose["state"].ravel()],
        np.r_[of_frame, by_pose["frame"].ravel()],
        by_pose["state"][-1] - by_pose["before last"],
        by_pose["frame"][-1] - by_pose["before frame"],
    )


def assert_follows(slope: np.ndarray, common: np.ndarray, covariance: np.ndarray, name: str) -> None:
    """The slope is minus `common` per error, to a thousandth of the largest, in standard deviations."""
    number = ERRORS.index(name)
    expected = -common[:, number] / SIGMA[NAMES.index(name)]
    # What is considered is not estimated, and so it is off by the error itself.
    assert expected[number] == pytest.approx(-1.0)
    rows = np.delete(np.arange(len(expected)), np.arange(CALIBRATION_SIZE)[CONSIDERED])
    expected, slope, sigma = (each[rows] for each in (expected, slope, np.sqrt(np.diag(covariance))))
    assert np.abs(expected / sigma).max() > 0.02 / NARROW
    np.testing.assert_allclose(slope / sigma, expected / sigma, atol=1e-3 * np.abs(expected / sigma).max())


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.parametrize("name", NAMES)
def test_estimates_follow_an_error_as_common_says(build: str, name: str):
    """Calibration and poses of the window, poses of the past, and all that a frame has to say of them."""
    solution, slope = BUILDS[build](GIVEN, SIGMA), slopes(build, name)
    state, joint = solution.window.posterior, solution.fit.joint
    assert len(state.past) == (0 if build == "window" else 2)
    order = np.r_[CALIBRATION, len(state.common) : len(state.common) + 6 * len(state.past)]
    order = np.r_[order, CALIBRATION_SIZE : len(state.common)]
    common = np.concatenate([state.common, state.past.common])[order]
    covariance = np.diag(np.r_[np.diag(state.covariance), np.diag(state.past.covariance)][order])
    assert_follows(slope.state, common, covariance, name)
    assert_follows(slope.frame, joint.common, joint.covariance, name)


@pytest.mark.parametrize("build", BUILDS)
def test_relative_covariances_gain_what_errors_do_to_relative_poses(build: str):
    """What they gain over those of a calibration without errors, by finite differences of relative poses."""
    solution, certain = BUILDS[build](GIVEN, SIGMA), BUILDS[build](GIVEN, np.zeros(len(NAMES)))
    each = [slopes(build, name) for name in NAMES]
    earlier = np.arange(KEYFRAMES)
    of_last, of_last_certain = (last_relative_to(s.window.posterior, earlier[:-1])[1] for s in (solution, certain))
    of_frame, of_frame_certain = (
        frame_relative_to(s.window.posterior, s.fit.joint, earlier)[1] for s in (solution, certain)
    )
    for whole_one, matching, by_error in (
        (of_last, of_last_certain, np.stack([slope.last for slope in each], axis=2)),
        (of_frame, of_frame_certain, np.stack([slope.frame_relative for slope in each], axis=2)),
    ):
        expected = by_error @ np.diag(SIGMA**2) @ by_error.transpose(0, 2, 1)
        for gained, right, before in zip(whole_one - matching, expected, matching, strict=True):
            sigma = np.sqrt(np.diag(before))
            assert (np.diag(right) / sigma**2).max() > 0.1
            tolerance = 2e-3 * (np.diag(right) / sigma**2).max()
            np.testing.assert_allclose(gained / np.outer(sigma, sigma), right / np.outer(sigma, sigma), atol=tolerance)


@pytest.mark.parametrize("build", BUILDS)
def test_estimates_are_those_of_a_calibration_without_errors(build: str):
    """Whatever is known of the errors: gains do not trust views less for them."""
    one, other = BUILDS[build](GIVEN, SIGMA), BUILDS[build](GIVEN, np.zeros(len(NAMES)))
    for key, poses in poses_of(one).items():
        np.testing.assert_allclose(poses, poses_of(other)[key], atol=1e-12, err_msg=key)
    assert in_sigmas(one.fit.covariance, other.fit.covariance) < 1e-9
    np.testing.assert_allclose(one.window.posterior.covariance, other.window.posterior.covariance, atol=1e-18)
    assert not other.window.posterior.common.any()
    assert not other.fit.joint.common.any()


# ---- what covariances say of that


@dataclass(frozen=True)
class Squared:
    """Squared errors of many worlds together.

    Attributes:
        whole, matching: by the whole covariance, and by the part of matches and motion.
        freedom: how many errors.
    """

    whole: float
    matching: float
    freedom: int


@pytest.mark.long
@pytest.mark.parametrize("linearisation", ["extended", "unscented"])
@pytest.mark.parametrize("build", BUILDS)
def test_errors_are_as_large_as_the_whole_covariance_says(build: str, linearisation: str):
    """40 worlds from the prior, within 99.9 % of their chi-square; the part of matches and motion is far outside.

    The calibration is five times worse than by default: these worlds are small.
    """
    default = CalibrationSigmas()
    worse = CalibrationSigmas(**{field.name: 5.0 * getattr(default, field.name) for field in fields(default)})
    prior = CalibrationPrior.of(CAMERA, worse, 0.0)
    sums: dict[str, Squared] = {}
    for seed in range(WORLDS):
        given = world(300 + seed, count=COUNT)
        errors = prior.sigma * np.random.default_rng(5000 + seed).standard_normal(len(ERRORS))
        solution = BUILDS[build](by_pair_with(given, errors), prior.sigma[CONSIDERED], linearisation)
        for key, found in squared_errors(given, solution).items():
            before = sums.get(key, Squared(0.0, 0.0, 0))
            sums[key] = Squared(*(a + b for a, b in zip(astuple(before), astuple(found), strict=True)))
    assert {"state", "last", "frame"} == set(sums)
    for key, found in sums.items():
        low, high = chi2.ppf([0.0005, 0.9995], found.freedom)
        assert low < found.whole < high, (key, *(each / found.freedom for each in (found.whole, low, high)))
        assert found.matching > 3.0 * high, (key, found.matching / found.freedom)


def squared_errors(given: World, solution: Solution) -> dict[str, Squared]:
    """Of estimated calibration and all poses, and of the last keyframe and the frame relative to the first keyframe."""
    state, first = solution.window.posterior, np.array([0])
    kept = np.r_[0 : len(ESTIMATED), CALIBRATION_SIZE : len(state.covariance) + 6 * len(state.past)]
    joint = np.block([[state.covariance, state.past.cross.T], [state.past.cross, state.past.covariance]])
    common = np.concatenate([state.common, state.past.common])
    true = np.concatenate([given.poses[len(state.past) : KEYFRAMES], given.poses[: len(state.past)]])
    calibration = given.calibration - state.calibration[: len(ESTIMATED)]
    error = np.r_[calibration, se3_log(true @ se3_inverse(np.concatenate([state.poses, state.past.poses]))).ravel()]
    matching, whole_one = joint[np.ix_(kept, kept)], (joint + common @ common.T)[np.ix_(kept, kept)]
    found = {"state": squared(error, whole_one, matching)}
    certain = without_errors(solution)
    parts = {
        "last": [last_relative_to(each.window.posterior, first) for each in (solution, certain)],
        "frame": [frame_relative_to(each.window.posterior, each.fit.joint, first) for each in (solution, certain)],
    }
    ends = {"last": (KEYFRAMES - 1, state.poses[-1]), "frame": (KEYFRAMES, solution.fit.pose)}
    for key, ((earlier, covariance), (_, part)) in parts.items():
        number, pose = ends[key]
        step = se3_inverse(given.poses[0]) @ given.poses[number]
        error = se3_log(earlier[0] @ step @ se3_inverse(pose))
        found[key] = squared(error, covariance[0], part[0])
    return found


def squared(error: np.ndarray, covariance: np.ndarray, matching: np.ndarray) -> Squared:
    """One error, by two covariances."""
    return Squared(*(float(squared_sigmas(error, each)) for each in (covariance, matching)), len(error))


def without_errors(solution: Solution) -> Solution:
    """The same estimates, as if nothing were wrong with the calibration."""
    window, joint = copy(solution.window), solution.fit.joint
    state = window.posterior
    past = replace(state.past, common=np.zeros_like(state.past.common))
    window.posterior = replace(state, common=np.zeros_like(state.common), past=past)
    return Solution(window, replace(solution.fit, joint=replace(joint, common=np.zeros_like(joint.common))))


def test_what_is_published_of_a_bad_calibration_is_as_if_its_sigmas_had_been_larger():
    growth = np.where(np.isin(NAMES, SHOWN), 3.0, 1.0)
    given, larger = (moving_on(GIVEN, sigma).window for sigma in (SIGMA, growth * SIGMA))
    given.worse, larger.worse = 3.0, 1.0
    for found, wanted in (
        (published_state(given).whole_covariance, larger.posterior.whole_covariance),
        (published_state(given).past.whole_covariance, larger.posterior.past.whole_covariance),
    ):
        scale = np.sqrt(np.diag(wanted))
        np.testing.assert_allclose(found / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=1e-4)
    assert np.array_equal(published_state(given).poses, given.posterior.poses)
    assert np.trace(published_state(given).whole_covariance) > 1.5 * np.trace(given.posterior.whole_covariance)


def test_what_neighbours_share_is_published_as_if_all_that_poses_come_from_were_so_much_less_certain():
    certain = without_errors(moving_on(GIVEN, SIGMA))
    window, given = certain.window, certain.window.posterior
    window.clustering = 2.0
    state, found = published_state(window), published_fit(window, certain.fit)
    earlier = np.arange(KEYFRAMES - 1)
    for relate, before, now in (
        (last_relative_to, (given,), (state,)),
        (frame_relative_to, (given, certain.fit.joint), (state, found.joint)),
    ):
        (poses, covariance), (published, wider) = relate(*before, earlier), relate(*now, earlier)
        np.testing.assert_allclose(published, poses, atol=1e-12)
        scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        np.testing.assert_allclose(
            wider / scale[:, None] / scale[..., None], 2.0 * covariance / scale[:, None] / scale[..., None], atol=1e-9
        )
    assert np.array_equal(state.poses, given.poses)
    assert published_state(window) is state


@pytest.mark.parametrize(("own", "counted"), [(1.0, 0.0), (1.5, 0.0), (5.0, 3.0)])
def test_what_a_frame_was_inflated_by_is_counted_once(own: float, counted: float):
    """`counted`: of the frame's own covariance, beside what is published of all poses."""
    solution = moving_on(GIVEN, SIGMA)
    solution.window.clustering = 2.0
    last, frame = slice(-12, -6), slice(-6, None)
    joint = solution.fit.joint.covariance
    relative = joint[frame, frame] + joint[last, last] - joint[frame, last] - joint[last, frame]
    published = published_fit(solution.window, solution.fit.inflated(own)).covariance
    np.testing.assert_allclose(published, 2.0 * joint[frame, frame] + counted * relative, rtol=1e-6)

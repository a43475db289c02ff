"""The window against dense least squares over all poses, the calibration and the landmarks together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, pose_slice
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from tests.support.dense_window import (
    CALIBRATION_SIGMA,
    CONSIDERED,
    DEPTH,
    FIRST_SIGMA,
    HOST_SIGMA,
    ITERATIONS,
    KEYFRAMES,
    NARROW,
    NO_WALK,
    STEP,
    STEP_SIGMA,
    Dense,
    add_keyframe,
    assert_same_state,
    dense_slice,
    eliminate,
    fit,
    in_sigmas,
    make_window,
    project,
    solved,
    unsolved,
    without_considered,
    world,
)

# ---- the joint solution


@pytest.mark.long
@pytest.mark.parametrize(("scale", "tolerance"), [(NARROW, 1e-4), (0.1, 1e-2), (1.0, 0.1)])
def test_the_solution_is_that_of_dense_least_squares(scale: float, tolerance: float):
    """Exactly so while rotations are small: their prior is not bent into the chart at the estimate."""
    for seed in range(2):
        given = world(seed, scale)
        window, dense = solved(given), Dense(given, KEYFRAMES).solve()
        assert_same_state(
            window.posterior.poses, window.posterior.calibration, window.posterior.covariance, dense, tolerance
        )
        found = (window.landmarks.estimate - dense.at[dense.size :].reshape(-1, 6)) / np.r_[scale * HOST_SIGMA, 1, 1]
        assert np.abs(found).max() < tolerance


@pytest.mark.long
def test_landmarks_given_the_state_have_the_dense_covariance_and_follow_it():
    given = world(3, NARROW)
    window, dense = solved(given), Dense(given, KEYFRAMES).solve()
    whole = np.linalg.inv(dense.information())
    for row in np.flatnonzero(given.host < KEYFRAMES - 1):
        place = slice(dense.size + 6 * row, dense.size + 6 * row + 6)
        follows = window.landmarks.dependence[row]
        found = window.landmarks.covariance[row] + follows @ window.posterior.covariance @ follows.T
        assert in_sigmas(found, whole[place, place]) < 1e-4


def test_landmarks_that_nobody_saw_again_stay_as_they_were_measured():
    given = world(0)
    window = solved(given)
    last = given.host == KEYFRAMES - 1
    np.testing.assert_array_equal(window.landmarks.estimate[last], given.measured[last])
    expected = np.diag(np.r_[HOST_SIGMA**2, 1.0, 1.0])
    np.testing.assert_allclose(window.landmarks.covariance[last], np.tile(expected, (last.sum(), 1, 1)))
    assert (window.landmarks.dependence[last] == 0).all()


def test_without_views_the_prior_stays():
    given = world(0)
    nothing = given.views[0]
    window = solved(replace(given, views=[nothing] * 4))
    size = CALIBRATION_SIZE + 6 * KEYFRAMES
    expected = np.zeros((size, size))
    expected[CALIBRATION, CALIBRATION] = np.diag(np.pad(CALIBRATION_SIGMA**2, (0, CALIBRATION_SIZE - 3)))
    for a in range(KEYFRAMES):
        for b in range(KEYFRAMES):
            common = FIRST_SIGMA**2 + min(a, b) * STEP_SIGMA**2
            expected[pose_slice(a), pose_slice(b)] = np.diag(common)
    np.testing.assert_allclose(window.posterior.covariance, expected, atol=1e-12)
    np.testing.assert_allclose(window.posterior.poses, given.expected[:KEYFRAMES], atol=1e-12)


@pytest.mark.parametrize("linearisation", ["extended", "unscented"])
def test_views_say_nothing_about_where_the_whole_window_is(linearisation: str):
    """The first keyframe keeps the covariance of its prior, and zero if that is zero."""
    given = world(1)
    window = solved(given, linearisation)
    first = pose_slice(0)
    np.testing.assert_allclose(window.posterior.covariance[first, first], np.diag(FIRST_SIGMA**2), atol=1e-9)
    window = make_window(CALIBRATION_SIGMA, linearisation)
    for k in range(KEYFRAMES):
        sigma = STEP_SIGMA if k else np.zeros(6)
        window.add_keyframe(given.expected[k], STEP if k else np.eye(4), np.diag(sigma**2), NO_WALK, DEPTH)
        window.add_views(given.views[k])
        own = np.flatnonzero(given.host == k)
        window.add_landmarks(own, given.measured[own, :3], np.tile(HOST_SIGMA**2, (len(own), 1)))
        window.solve()
    assert np.abs(window.posterior.covariance[first]).max() < 1e-15
    np.testing.assert_allclose(window.posterior.poses[0], np.eye(4), atol=1e-12)
    assert fit(window, given).covariance[0, 0] > 1e-8


def test_a_common_uncertainty_of_all_poses_is_not_seen_in_the_views():
    """A metre and a tenth of a radian that host and frame have in common leave the prediction certain."""
    window = make_window(np.zeros(3), "unscented")
    given = world(0)
    window.add_keyframe(STEP, STEP, np.diag(np.repeat([1.0, 0.1], 3) ** 2), NO_WALK, DEPTH)
    window.add_landmarks(np.arange(12), given.measured[:, :3], np.full((12, 4), 1e-8))
    _, covariance, in_front = FrameUpdate(window, ITERATIONS).predict(np.arange(12), STEP @ STEP, np.zeros((6, 6)))
    assert in_front.all()
    assert np.abs(covariance).max() < 1e-5


@pytest.mark.parametrize("linearisation", ["extended", "unscented"])
def test_order_of_the_views_does_not_matter(linearisation: str):
    given = world(2)
    one, other = solved(given, linearisation), solved(given, linearisation, order=-1)
    np.testing.assert_allclose(one.posterior.poses, other.posterior.poses, atol=1e-9)
    np.testing.assert_allclose(one.posterior.covariance, other.posterior.covariance, atol=1e-8)
    views = given.views[-1]
    turned = views.select(np.arange(len(views.landmark))[::-1])
    first, second = fit(one, given), fit(one, given, turned)
    np.testing.assert_allclose(first.pose, second.pose, atol=1e-9)
    np.testing.assert_allclose(first.covariance, second.covariance, atol=1e-9)
    np.testing.assert_array_equal(first.inliers, second.inliers[::-1])


def test_a_disparity_that_is_not_there_is_one_that_is_unknown():
    given = world(2)
    filled = []
    for views in given.views:
        missing = np.isnan(views.measurement[:, 2])
        measurement, noise = views.measurement.copy(), views.noise.copy()
        measurement[missing, 2] = 10.0
        noise[missing, 2, :], noise[missing, :, 2], noise[missing, 2, 2] = 0.0, 0.0, 1e10
        filled.append(replace(views, measurement=measurement, noise=noise))
    assert any(np.isnan(views.measurement).any() for views in given.views[1:])
    one, other = solved(given), solved(replace(given, views=filled))
    np.testing.assert_allclose(one.posterior.poses, other.posterior.poses, atol=1e-7)
    np.testing.assert_allclose(one.posterior.covariance, other.posterior.covariance, rtol=1e-4, atol=1e-9)
    first, second = fit(one, given), fit(one, given, filled[-1])
    np.testing.assert_allclose(first.pose, second.pose, atol=1e-6)
    assert first.dof < second.dof


def test_views_that_do_not_fit_are_forgotten():
    """Two views are sixteen deviations off; after the next solution it is as if they had never been."""
    given = world(0, count=120)
    # Claimed to be worse than they are, so that no right one is near the gate.
    views = [replace(v, noise=4 * v.noise) for v in given.views]
    wrong = views[2].measurement.copy()
    wrong[[3, 8], 1] += 8.0
    right = np.ones(len(wrong), bool)
    right[[3, 8]] = False
    broken = unsolved(replace(given, views=[*views[:2], replace(views[2], measurement=wrong), views[3]]))
    clean = solved(replace(given, views=[*views[:2], views[2].select(right), views[3]]))
    broken.solve()
    sigma = np.sqrt(np.diag(clean.posterior.covariance)[CALIBRATION_SIZE:])
    assert np.abs(se3_log(broken.posterior.poses @ se3_inverse(clean.posterior.poses)).ravel() / sigma).max() > 0.2
    broken.solve(8)
    np.testing.assert_allclose(broken.posterior.poses, clean.posterior.poses, atol=1e-8)
    np.testing.assert_allclose(broken.posterior.covariance, clean.posterior.covariance, atol=1e-8)


# ---- the frame


@pytest.mark.long
@pytest.mark.parametrize(("scale", "tolerance"), [(NARROW, 1e-3), (0.1, 2e-2), (1.0, 0.2)])
def test_a_frame_equals_one_more_pose_in_dense_least_squares(scale: float, tolerance: float):
    """Pose, covariance, also relative to the last keyframe, calibration; and the NIS is what it adds to the cost."""
    for seed in range(2):
        given = world(seed, scale)
        found = fit(solved(given), given)
        assert found.inliers.all()
        before, dense = Dense(given, KEYFRAMES).solve(), Dense(given, KEYFRAMES + 1).solve()
        covariance = dense.covariance()
        frame, last, calibration = dense_slice(KEYFRAMES), dense_slice(KEYFRAMES - 1), slice(0, 3)
        relative = np.zeros((6, dense.size))
        relative[:, frame], relative[:, last] = np.eye(6), -np.eye(6)
        sigma = np.sqrt(np.diag(covariance))
        error = np.r_[found.calibration[:3] - dense.at[:3], se3_log(found.pose @ se3_inverse(dense.poses[-1]))]
        assert np.abs(error / sigma[np.r_[0:3, frame]]).max() < tolerance
        assert in_sigmas(found.covariance, covariance[frame, frame]) < tolerance
        calibration_covariance = without_considered(found.joint.covariance[CALIBRATION, CALIBRATION])
        assert in_sigmas(calibration_covariance, covariance[calibration, calibration]) < tolerance
        np.testing.assert_allclose(found.calibration[CONSIDERED], 0.0, atol=1e-12)
        assert in_sigmas(found.relative, relative @ covariance @ relative.T) < tolerance
        assert found.nis == pytest.approx(dense.cost - before.cost, rel=tolerance)
        assert found.dof == np.isfinite(given.views[-1].measurement).sum()


def test_a_frame_leaves_the_window_as_it_was():
    given = world(0)
    window = solved(given)
    poses, covariance, estimate = (
        window.posterior.poses.copy(),
        window.posterior.covariance.copy(),
        window.landmarks.estimate.copy(),
    )
    fit(window, given)
    np.testing.assert_array_equal(window.posterior.poses, poses)
    np.testing.assert_array_equal(window.posterior.covariance, covariance)
    np.testing.assert_array_equal(window.landmarks.estimate, estimate)


def test_a_frame_that_starts_from_elsewhere_ends_at_the_same_place():
    """The prior's own mean and the truth, ten standard deviations of the result apart."""
    given = world(0, count=60)
    window = solved(given)
    one, other = fit(window, given), fit(window, given, start=given.poses[-1])
    sigma = np.sqrt(np.diag(one.covariance))
    assert np.abs(se3_log(one.pose @ se3_inverse(other.pose)) / sigma).max() < 0.05
    assert in_sigmas(other.covariance, one.covariance) < 0.05
    np.testing.assert_array_equal(one.inliers, other.inliers)


@pytest.mark.parametrize("linearisation", ["extended", "unscented"])
def test_wrong_matches_of_a_frame_are_left_out(linearisation: str):
    """A quarter of the views lie anywhere; the fit is the one without them."""
    given = world(4, count=80)
    window = solved(given, linearisation)
    views = given.views[-1]
    rng = np.random.default_rng(0)
    wrong = rng.random(len(views.landmark)) < 0.25
    measurement = views.measurement.copy()
    measurement[wrong, :2] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(8, 60, (wrong.sum(), 2))
    found, clean = fit(window, given, replace(views, measurement=measurement)), fit(window, given, views.select(~wrong))
    assert not found.inliers[wrong].any()
    assert found.inliers[~wrong].mean() > 0.95
    sigma = np.sqrt(np.diag(clean.covariance))
    assert np.abs(se3_log(found.pose @ se3_inverse(clean.pose)) / sigma).max() < 0.05


def test_too_few_views_that_agree_are_no_pose():
    given = world(0, count=30)
    window, views = solved(given), given.views[-1]
    scattered = replace(views, measurement=views.measurement + np.random.default_rng(0).uniform(20, 90, (30, 3)))
    step = np.diag(STEP_SIGMA**2)
    assert FrameUpdate(window, ITERATIONS).fit(scattered, window.posterior.poses[-1] @ STEP, step, 15) is None
    assert (
        FrameUpdate(window, ITERATIONS).fit(views.select(np.arange(14)), window.posterior.poses[-1] @ STEP, step, 15)
        is None
    )


def test_predictions_are_where_the_frame_then_sees_the_landmarks():
    """NEES of measured places under the predicted covariance and the noise, over worlds."""
    values = []
    for seed in range(12):
        given = world(seed, count=30)
        views = given.views[-1].select(np.isfinite(given.views[-1].measurement[:, 2]))
        window = solved(given, "unscented")
        mean, covariance, in_front = FrameUpdate(window, ITERATIONS).predict(
            views.landmark, window.posterior.poses[-1] @ STEP, np.diag(STEP_SIGMA**2)
        )
        assert in_front.all()
        error = (views.measurement - mean)[..., None]
        values.append((error * np.linalg.solve(covariance + views.covariance, error)).sum(axis=(1, 2)).mean() / 3)
    # Views of one frame share its pose: the mean over the worlds scatters as that of a dozen such numbers does.
    assert 0.6 < np.mean(values) < 1.5


def test_an_update_sees_what_the_window_learns():
    """What it keeps between frames is not that of the window before."""
    window = unsolved(world(0, count=30), "unscented")
    update, rows = FrameUpdate(window, ITERATIONS), np.arange(30)
    before = update.predict(rows, window.posterior.poses[-1] @ STEP, np.diag(STEP_SIGMA**2))
    window.solve()
    asked = rows, window.posterior.poses[-1] @ STEP, np.diag(STEP_SIGMA**2)
    after = update.predict(*asked)
    assert np.abs(after[1] - before[1]).max() > 1e-3
    for found, expected in zip(after, FrameUpdate(window, ITERATIONS).predict(*asked), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.long
@pytest.mark.parametrize("linearisation", ["extended", "unscented"])
def test_errors_are_as_large_as_the_covariance_says(linearisation: str):
    """40 worlds from the prior: NEES of frame, window and calibration, and NIS, within 99.9 % of their chi-square."""
    worlds, frame, state, calibration, nis, dof = 40, 0.0, 0.0, 0.0, 0.0, 0
    for seed in range(worlds):
        given = world(100 + seed, count=60)
        window = unsolved(given, linearisation)
        window.solve(3)
        found = fit(window, given)
        error = se3_log(given.poses[-1] @ se3_inverse(found.pose))
        frame += error @ np.linalg.solve(found.covariance, error)
        error = np.r_[
            given.calibration - window.posterior.calibration[:3],
            se3_log(given.poses[:KEYFRAMES] @ se3_inverse(window.posterior.poses)).ravel(),
        ]
        state += error @ np.linalg.solve(without_considered(window.posterior.covariance), error)
        error = given.calibration - found.calibration[:3]
        calibration += error @ np.linalg.solve(
            without_considered(found.joint.covariance[CALIBRATION, CALIBRATION]), error
        )
        nis, dof = nis + found.nis, dof + found.dof
    for total, freedom in ((frame, 6 * worlds), (state, 21 * worlds), (calibration, 3 * worlds), (nis, dof)):
        low, high = chi2.ppf([0.0005, 0.9995], freedom)
        assert low < total < high, (total / freedom, low / freedom, high / freedom)


# ---- leaving keyframes


@pytest.mark.long
def test_what_a_retired_keyframe_leaves_is_the_dense_marginal():
    """All landmarks are the first keyframe's: with it they go, and Schur's complement is the prior of the rest."""
    for scale, tolerance in ((NARROW, 1e-4), (0.1, 1e-2)):
        given = world(1, scale, count=18, hosts=1)
        window, dense = solved(given), Dense(given, KEYFRAMES).solve()
        kept = np.r_[0:3, 9 : dense.size]
        expected = np.linalg.inv(eliminate(dense.information(), kept))
        window.marginalise_oldest()
        assert len(window.landmarks) == 0
        window.solve()
        assert in_sigmas(without_considered(window.posterior.covariance), expected) < tolerance
        error = np.r_[
            window.posterior.calibration[:3] - dense.at[:3],
            se3_log(window.posterior.poses @ se3_inverse(dense.poses[1:])).ravel(),
        ]
        assert np.abs(error / np.sqrt(np.diag(expected))).max() < tolerance


@pytest.mark.parametrize("linearisation", ["extended", "unscented"])
def test_a_retired_keyframe_changes_nothing_of_what_is_known_of_the_rest(linearisation: str):
    given = world(1, 0.1, count=30)
    window = solved(given, linearisation)
    rest = np.r_[0:3, dense_slice(1).start : dense_slice(KEYFRAMES).start]
    poses, covariance = window.posterior.poses[1:], without_considered(window.posterior.covariance)[np.ix_(rest, rest)]
    gone = int((given.host == 0).sum())
    number = window.marginalise_oldest()
    np.testing.assert_array_equal(number, np.where(given.host == 0, -1, np.arange(len(given.host)) - gone))
    np.testing.assert_array_equal(window.landmarks.anchor, given.host[given.host > 0] - 1)
    np.testing.assert_array_equal(window.landmarks.id, np.flatnonzero(given.host > 0))
    window.solve(4)
    assert in_sigmas(without_considered(window.posterior.covariance), covariance) < 1e-3
    error = se3_log(window.posterior.poses @ se3_inverse(poses)).ravel()
    assert np.abs(error / np.sqrt(np.diag(covariance)[3:])).max() < 1e-3


@pytest.mark.long
def test_a_window_that_moves_on_equals_the_whole_problem():
    """The first keyframe retires and the frame becomes a keyframe, which sees landmarks of the others."""
    given = world(1, NARROW, count=30)
    views = given.views[-1].select(given.host[given.views[-1].landmark] > 0)
    given = replace(given, views=[*given.views[:-1], views])
    window = solved(given)
    add_keyframe(window, given, KEYFRAMES, views.renumber(window.marginalise_oldest()), hosted=False)
    window.solve(8)
    dense = Dense(given, KEYFRAMES + 1).solve()
    assert_same_state(
        window.posterior.poses, window.posterior.calibration, window.posterior.covariance, dense, 1e-4, first=1
    )


@pytest.mark.long
def test_a_long_chain_of_windows_stays_rigid():
    """100 keyframes, each from the last by products with inverses by transposition: defects that double would show."""
    given = world(0, count=30)
    at_origin, rows = np.tile(np.eye(4), (30, 1, 1)), np.arange(30)
    places = project(STEP, at_origin, np.zeros(3), given.landmarks)
    seen = LandmarkViews(rows, places, np.tile(0.1 * np.eye(3), (30, 1, 1)), np.zeros((30, 3, 2)))
    window = make_window(CALIBRATION_SIGMA)
    for k in range(100):
        if len(window) == 2:
            window.marginalise_oldest()
        first = not len(window)
        pose = np.eye(4) if first else window.posterior.poses[-1] @ STEP
        window.add_keyframe(pose, np.eye(4) if first else STEP, np.diag(STEP_SIGMA**2), NO_WALK, DEPTH)
        if k:
            window.add_views(seen)
        window.add_landmarks(rows, given.landmarks[:, :3], np.tile(HOST_SIGMA**2, (30, 1)))
        window.solve()
    R = window.posterior.poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(window.posterior.covariance, window.posterior.covariance.T, rtol=0, atol=1e-12)


def test_noise_that_is_larger_than_claimed_is_found_before_the_gate_hides_it():
    given = world(0, count=200)
    window, views = solved(given), given.views[-1]
    rng = np.random.default_rng(1)
    blurred = replace(views, measurement=views.measurement + 2.0 * rng.normal(0, 0.26, views.measurement.shape))
    step = np.diag(STEP_SIGMA**2)
    good = FrameUpdate(window, ITERATIONS).fit(views, window.posterior.poses[-1] @ STEP, step, 15)
    bad = FrameUpdate(window, ITERATIONS).fit(blurred, window.posterior.poses[-1] @ STEP, step, 15)
    assert good is not None
    assert bad is not None
    assert good.noise_scale == 1.0
    assert 2.0 < bad.noise_scale < 8.0
    assert bad.inliers.mean() > 0.95
    assert np.trace(bad.relative) > 1.5 * np.trace(good.relative)

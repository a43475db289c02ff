"""Poses relative to earlier keyframes: against dense least squares, and against the window's own update."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.relative_covariance import frame_relative_to, last_relative_to
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.inference.backends import load_step
from tests.support.dense_window import (
    ITERATIONS,
    KEYFRAMES,
    NARROW,
    NO_WALK,
    STEP,
    STEP_SIGMA,
    Dense,
    World,
    dense_slice,
    fit,
    in_sigmas,
    unsolved,
    world,
)


def split(given: World) -> tuple[KeyframeWindow, World, LandmarkViews]:
    """A window whose first keyframe is in the past, the world of it and a frame, and the frame's views by its rows."""
    window = unsolved(given)
    window.solve(8)
    new_row = window.marginalise_oldest()
    window.solve(8)
    # A frame does not see the landmarks that have gone with their keyframe.
    seen = given.views[-1].select(given.host[given.views[-1].landmark] > 0)
    return window, replace(given, views=[*given.views[:-1], seen]), seen.renumber(new_row)


def expected(dense: Dense, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """T_i_j and the covariance of j relative to i, perturbed from the left in the world."""
    covariance = dense.covariance()
    blocks = [dense_slice(i), dense_slice(j)]
    difference = np.zeros((6, len(covariance)))
    difference[:, blocks[0]], difference[:, blocks[1]] = -np.eye(6), np.eye(6)
    return se3_inverse(dense.poses[i]) @ dense.poses[j], difference @ covariance @ difference.T


def assert_same(pose: np.ndarray, covariance: np.ndarray, dense: Dense, i: int, j: int) -> None:
    right, spread = expected(dense, i, j)
    assert in_sigmas(covariance, spread) < 2e-3
    assert np.abs(se3_log(se3_inverse(right) @ pose) / np.sqrt(np.diag(spread))).max() < 2e-3


@pytest.mark.parametrize("seed", range(3))
def test_the_last_keyframe_relative_to_past_and_window_is_the_dense_solution(seed: int):
    window, given, _ = split(world(seed, NARROW, count=30))
    dense = Dense(given, KEYFRAMES).solve()
    poses, covariances = last_relative_to(window.posterior, np.arange(KEYFRAMES - 1))
    for i, (pose, covariance) in enumerate(zip(poses, covariances, strict=True)):
        assert_same(se3_inverse(pose) @ window.posterior.poses[-1], covariance, dense, i, KEYFRAMES - 1)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_frame_relative_to_past_and_window_is_the_dense_solution(seed: int):
    """Also relative to a keyframe whose landmarks it does not see: what it says of the others moves that one, too."""
    window, given, views = split(world(seed, NARROW, count=30))
    found = fit(window, given, views)
    dense = Dense(given, KEYFRAMES + 1).solve()
    poses, covariances = frame_relative_to(window.posterior, found.joint, np.arange(KEYFRAMES))
    for i, (pose, covariance) in enumerate(zip(poses, covariances, strict=True)):
        assert_same(se3_inverse(pose) @ found.pose, covariance, dense, i, KEYFRAMES)


def test_what_all_poses_have_in_common_does_not_matter():
    """All of them known ten thousand times less well than relative to each other."""
    window, given, views = split(world(0, NARROW, count=30))
    index = np.arange(KEYFRAMES)
    _, before = frame_relative_to(window.posterior, fit(window, given, views).joint, index)
    posterior = window.posterior
    common = np.diag(np.repeat([0.1, 0.01], 3) ** 2)
    size, past = len(posterior.covariance), posterior.past
    poses = (size - CALIBRATION_SIZE) // 6
    covariance = posterior.covariance.copy()
    covariance[CALIBRATION_SIZE:, CALIBRATION_SIZE:] += np.kron(np.ones((poses, poses)), common)
    cross = past.cross.copy()
    cross[:, CALIBRATION_SIZE:] += np.kron(np.ones((len(past), poses)), common)
    whole = past.covariance + np.kron(np.ones((len(past), len(past))), common)
    window.posterior = replace(posterior, covariance=covariance, past=replace(past, covariance=whole, cross=cross))
    _, after = frame_relative_to(window.posterior, fit(window, given, views).joint, index)
    for one, other in zip(before, after, strict=True):
        assert in_sigmas(other, one) < 1e-3


def test_a_frame_s_relative_pose_is_that_of_the_window_s_own_update():
    """Appended to the window, and the window conditioned on the views with all of its past."""
    window, given, views = split(world(1, NARROW, count=30))
    found, state = fit(window, given, views), window.posterior
    step = np.diag((given.scale * STEP_SIGMA) ** 2)
    grown = state.grow(state.poses[-1] @ STEP, step, NO_WALK)
    vector = found.joint.score + found.joint.information @ found.joint.step
    moved = grown.given(found.joint.information, vector, load_step("window_condition", "onnx"))
    poses, covariances = frame_relative_to(state, found.joint, np.arange(KEYFRAMES))
    others, expected_covariances = last_relative_to(moved, np.arange(KEYFRAMES))
    for one, other in zip(covariances, expected_covariances, strict=True):
        assert in_sigmas(one, other) < 1e-6
    np.testing.assert_allclose(poses, others, atol=1e-9)
    np.testing.assert_allclose(found.pose, moved.poses[-1], atol=1e-9)
    np.testing.assert_array_equal(found.last, state.poses[-1])
    by_sensor = FrameUpdate(window, ITERATIONS, moves_last=True).fit(views, state.poses[-1] @ STEP, step, 5)
    assert by_sensor is not None
    assert np.abs(by_sensor.step - found.step).max() > 1e-6
    np.testing.assert_allclose(by_sensor.step, se3_inverse(moved.poses[-2]) @ moved.poses[-1], atol=1e-9)


def test_relating_a_frame_changes_nothing():
    window, given, views = split(world(2, NARROW, count=30))
    found = fit(window, given, views)
    state = window.posterior
    before = [state.poses.copy(), state.covariance.copy(), state.past.poses.copy(), found.joint.covariance.copy()]
    frame_relative_to(state, found.joint, np.array([1, 0]))
    after = [state.poses, state.covariance, state.past.poses, found.joint.covariance]
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.long
def test_errors_of_a_frame_relative_to_the_past_are_as_large_as_the_covariance_says():
    ratios = []
    for seed in range(60):
        window, given, views = split(world(seed, 0.1, count=30))
        found = FrameUpdate(window, ITERATIONS).fit(
            views, window.posterior.poses[-1] @ STEP, np.diag((given.scale * STEP_SIGMA) ** 2), 5
        )
        assert found is not None
        poses, covariances = frame_relative_to(window.posterior, found.joint, np.array([0]))
        true = se3_inverse(given.poses[0]) @ given.poses[-1]
        error = se3_log(poses[0] @ true @ se3_inverse(found.pose))
        ratios.append(error @ np.linalg.solve(covariances[0], error) / 6)
    # The mean of sixty scatters by 0.075.
    assert 0.75 < np.mean(ratios) < 1.25

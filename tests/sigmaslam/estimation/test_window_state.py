"""The Gaussian of a window against dense linear algebra: marginalising, closing loops and forgetting in any order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sigmaslam.estimation.calibration_errors import ERRORS, CalibrationPrior
from sigmaslam.estimation.marginalised_poses import PastPoses
from sigmaslam.estimation.relative_covariance import relative_to_first
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, pose_slice
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.inference.backends import load_step

POSES, PAST = 3, 2
NO_WALK = np.zeros(CALIBRATION_SIZE)
CONDITION = load_step("window_condition", "onnx")
LOOP_SIGMA = 1e-5 * np.array([1.0, 2.0, 3.0, 0.5, 0.4, 0.3])


def random_state(seed: int) -> WindowState:
    """Poses anywhere; errors so small that exponentials add up."""
    rng = np.random.default_rng(seed)
    size = CALIBRATION_SIZE + 6 * (POSES + PAST)
    root = 1e-4 * rng.normal(size=(size, size))
    joint, own = root @ root.T, CALIBRATION_SIZE + 6 * POSES
    poses = se3_exp(rng.normal(0.0, [2.0, 2.0, 2.0, 0.5, 0.5, 0.5], (POSES + PAST, 6)))
    calibration, common = 1e-3 * rng.normal(size=CALIBRATION_SIZE), 1e-4 * rng.normal(size=(size, CALIBRATION_SIZE))
    past = PastPoses(poses[POSES:], joint[own:, own:], joint[own:, :own], common[own:])
    return WindowState(calibration, poses[:POSES], joint[:own, :own], common[:own], past)


def measured(state: WindowState, index: int, seed: int) -> np.ndarray:
    """The last pose as a past one sees it, with an error."""
    error = se3_exp(LOOP_SIGMA * np.random.default_rng(1000 + seed).normal(size=6))
    return np.asarray(se3_inverse(state.past.poses[index]) @ error @ state.poses[-1])


def joint_of(state: WindowState) -> np.ndarray:
    """Covariance of calibration, past poses and poses of the window, in the order in which they were."""
    whole = np.block([[state.covariance, state.past.cross.T], [state.past.cross, state.past.covariance]])
    own = len(state.covariance)
    order = np.r_[CALIBRATION, own : len(whole), CALIBRATION_SIZE:own]
    return whole[np.ix_(order, order)]


def common_of(state: WindowState) -> np.ndarray:
    """How considered errors enter the same, in that order."""
    own = state.common
    return np.concatenate([own[CALIBRATION], state.past.common, own[CALIBRATION_SIZE:]])


def poses_of(state: WindowState) -> np.ndarray:
    return np.concatenate([state.past.poses, state.poses])


def assert_same(one: WindowState, other: WindowState) -> None:
    scale = np.sqrt(np.diag(joint_of(other)))
    np.testing.assert_allclose(one.calibration, other.calibration, atol=1e-6 * scale[CALIBRATION].min())
    difference = se3_log(poses_of(one) @ se3_inverse(poses_of(other))).ravel()
    assert np.abs(difference / scale[CALIBRATION_SIZE:]).max() < 1e-6
    assert np.abs((joint_of(one) - joint_of(other)) / np.outer(scale, scale)).max() < 1e-6
    assert np.abs((common_of(one) - common_of(other)) / scale[:, None]).max() < 1e-6


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), index=st.integers(0, PAST - 1))
def test_marginalising_and_closing_a_loop_commute(seed: int, index: int):
    state = random_state(seed)
    T, covariance = measured(state, index, seed), np.diag(LOOP_SIGMA**2)
    first = state.add_loop_constraint(index, T, covariance).marginalise_oldest()
    then = state.marginalise_oldest().add_loop_constraint(index, T, covariance)
    assert_same(first, then)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), index=st.integers(0, PAST - 1))
def test_a_loop_is_the_update_of_all_poses_together(seed: int, index: int):
    """The Kalman update of the joint covariance, written down densely; considered errors pass through its gain."""
    state = random_state(seed)
    T, R = measured(state, index, seed), np.diag(LOOP_SIGMA**2)
    after = state.add_loop_constraint(index, T, R)
    P = joint_of(state)
    H = np.zeros((6, len(P)))
    H[:, -6:], H[:, pose_slice(index)] = np.eye(6), -np.eye(6)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    step = gain @ se3_log(state.past.poses[index] @ T @ se3_inverse(state.poses[-1]))
    scale = np.sqrt(np.diag(P))
    moved = se3_log(poses_of(after) @ se3_inverse(poses_of(state))).ravel()
    assert np.abs((np.r_[after.calibration - state.calibration, moved] - step) / scale).max() < 1e-6
    assert np.abs((joint_of(after) - (P - gain @ H @ P)) / np.outer(scale, scale)).max() < 1e-6
    C = common_of(state)
    assert np.abs((common_of(after) - (C - gain @ H @ C)) / scale[:, None]).max() < 1e-6


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_what_is_learned_of_the_window_is_the_update_of_all_poses_together(seed: int):
    """Of three numbers that depend on the window's state; considered errors pass through the gain."""
    state = random_state(seed)
    rng = np.random.default_rng(seed)
    own = np.r_[CALIBRATION, pose_slice(PAST).start : len(joint_of(state))]
    H = np.zeros((3, len(joint_of(state))))
    H[:, own] = rng.normal(size=(3, len(own)))
    R, difference = 1e-8 * np.diag([1.0, 2.0, 3.0]), 1e-4 * rng.normal(size=3)
    weighted = H[:, own].T @ np.linalg.inv(R)
    after = state.given(weighted @ H[:, own], weighted @ difference, CONDITION)
    P, C = joint_of(state), common_of(state)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    scale = np.sqrt(np.diag(P))
    moved = se3_log(poses_of(after) @ se3_inverse(poses_of(state))).ravel()
    step = np.r_[after.calibration - state.calibration, moved]
    assert np.abs((step - gain @ difference) / scale).max() < 1e-6
    assert np.abs((joint_of(after) - (P - gain @ H @ P)) / np.outer(scale, scale)).max() < 1e-6
    assert np.abs((common_of(after) - (C - gain @ H @ C)) / scale[:, None]).max() < 1e-6


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_learning_of_the_window_and_marginalising_commute(seed: int):
    """What is learned of the poses that stay; the pose that leaves follows it either way."""
    state = random_state(seed)
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(4, len(state.covariance))) / 1e-4
    rows[:, pose_slice(0)] = 0.0
    information, vector = rows.T @ rows, rows.T @ rng.normal(size=4)
    stays = np.r_[CALIBRATION, pose_slice(1).start : len(vector)]
    first = state.given(information, vector, CONDITION).marginalise_oldest()
    then = state.marginalise_oldest().given(information[np.ix_(stays, stays)], vector[stays], CONDITION)
    assert_same(first, then)


@pytest.mark.parametrize("index", range(PAST))
def test_forgetting_a_pose_leaves_the_others_as_they_were(index: int):
    state = random_state(index)
    remaining = np.delete(np.arange(pose_slice(PAST + POSES).start), pose_slice(index))
    after = replace(state, past=state.past.drop(index))
    np.testing.assert_array_equal(joint_of(after), joint_of(state)[np.ix_(remaining, remaining)])
    np.testing.assert_array_equal(common_of(after), common_of(state)[remaining])
    np.testing.assert_array_equal(poses_of(after), np.delete(poses_of(state), index, axis=0))


def test_a_new_pose_is_as_far_from_the_last_as_its_step_says():
    state, step, walk = random_state(0), 1e-4 * np.eye(6), np.eye(CALIBRATION_SIZE)[0]
    grown = state.grow(np.eye(4), step, 4.0 * walk)
    before, after = state.covariance, grown.covariance
    np.testing.assert_array_equal(after[-6:, -6:], before[-6:, -6:] + step)
    np.testing.assert_array_equal(after[-6:, CALIBRATION_SIZE:-6], before[-6:, CALIBRATION_SIZE:])
    calibration = before[CALIBRATION, CALIBRATION] + np.diag(4.0 * walk)
    np.testing.assert_array_equal(after[CALIBRATION, CALIBRATION], calibration)
    np.testing.assert_array_equal(grown.past.cross[:, -6:], state.past.cross[:, -6:])


def test_a_new_pose_has_the_considered_errors_of_the_one_it_is_relative_to():
    """Of the last one, or of the past one that a new start is relative to; of the world there are none."""
    state, step = random_state(0), 1e-4 * np.eye(6)
    grown = state.grow(np.eye(4), step, NO_WALK)
    np.testing.assert_array_equal(grown.common[:-6], state.common)
    np.testing.assert_array_equal(grown.common[-6:], state.common[-6:])
    empty = replace(state.without_poses(), past=state.all_poses)
    empty = replace(empty, past=replace(empty.past, cross=empty.past.cross[:, CALIBRATION]))
    for origin, expected in ((3, state.common[pose_slice(3 - PAST)]), (None, np.zeros((6, CALIBRATION_SIZE)))):
        np.testing.assert_array_equal(empty.grow(np.eye(4), step, NO_WALK, origin).common[-6:], expected)


@pytest.mark.long
def test_considered_errors_are_part_of_the_whole_covariance():
    """Draws of the state's errors, and of considered ones of variance one that enter them."""
    state, rng, count = random_state(3), np.random.default_rng(0), 200_000
    for part in (state, state.past, state.all_poses):
        matching = np.linalg.cholesky(part.covariance + 1e-16 * np.eye(len(part.covariance)))
        errors = rng.normal(size=(count, len(matching))) @ matching.T
        errors += rng.normal(size=(count, CALIBRATION_SIZE)) @ part.common.T
        scale = np.sqrt(np.diag(part.whole_covariance))
        # Correlations of so many draws scatter by 0.003 at most.
        found = errors.T @ errors / count
        assert np.abs((found - part.whole_covariance) / np.outer(scale, scale)).max() < 0.02
        assert np.abs((found - part.covariance) / np.outer(scale, scale)).max() > 0.02


def test_of_a_state_without_poses_the_calibration_remains():
    state = random_state(1)
    alone = state.without_poses()
    assert len(alone) == len(alone.past) == 0
    np.testing.assert_array_equal(alone.covariance, state.covariance[CALIBRATION, CALIBRATION])
    np.testing.assert_array_equal(alone.common, state.common[CALIBRATION])
    np.testing.assert_array_equal(alone.calibration, state.calibration)


def test_all_poses_are_the_marginalised_ones_before_those_of_the_window():
    """As if the window were marginalised pose by pose, but that it keeps them."""
    state = random_state(0)
    together, one_by_one = state.all_poses, state
    for _ in range(POSES):
        one_by_one = one_by_one.marginalise_oldest()
    np.testing.assert_array_equal(together.poses, one_by_one.past.poses)
    np.testing.assert_array_equal(together.covariance, one_by_one.past.covariance)
    np.testing.assert_array_equal(together.cross[:, CALIBRATION], one_by_one.past.cross)
    np.testing.assert_array_equal(together.common, one_by_one.past.common)


def test_covariances_relative_to_a_pose_are_those_of_the_differences():
    """As far as they come from matches and motion."""
    poses = random_state(1).all_poses
    poses = replace(poses, common=np.zeros_like(poses.common))
    joint = relative_to_first(poses, [1, 3, 0])
    back = se3_inverse(poses.poses[1])
    for k, index in enumerate((3, 0)):
        block = slice(6 * k, 6 * k + 6)
        np.testing.assert_allclose(joint[block, block], turn_covariance(back, poses.relative(index)[1]), atol=1e-18)
    np.testing.assert_allclose(joint, joint.T, atol=1e-18)
    assert np.linalg.eigvalsh(joint)[0] > -1e-18


def test_another_baseline_moves_poses_as_a_considered_one_would():
    """Of variance one, it enters them as a column of `common`; with a mean and more variance the poses go along."""
    prior = CalibrationPrior.independent(np.r_[0.5, np.full(10, 0.2), 0.001], "offset")
    state = random_state(3)
    state = replace(state, common=np.c_[np.zeros(len(state.common)), state.common[:, 1:]])
    wider = prior.widened(np.isin(ERRORS, "baseline") * 0.05)
    baseline = ERRORS.index("baseline")
    by_error = np.linalg.pinv(prior.considered_factor)
    to_factor = by_error @ wider.considered_factor
    after, step = state.with_errors(np.array([baseline]), np.array([0.05]), by_error, to_factor)
    expected = state.common[:, baseline] / 0.001
    np.testing.assert_allclose(step, expected * (0.05 - state.calibration[baseline]), rtol=1e-9)
    np.testing.assert_allclose(after.minus(state), step, atol=1e-9 * np.abs(step).max())
    np.testing.assert_allclose(after.common[:, baseline], np.hypot(0.001, 0.05) * expected, rtol=1e-9)
    past, past_after = (each.past.common[:, baseline] for each in (state, after))
    np.testing.assert_allclose(past_after, np.hypot(1.0, 50.0) * past, rtol=1e-9)
    np.testing.assert_allclose(after.common[:, 1:baseline], state.common[:, 1:baseline], rtol=1e-9)
    np.testing.assert_array_equal(after.covariance, state.covariance)

"""Poses that left the window: against dense least squares, against a pose graph, and what must not change them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.marginalised_poses import PastPoses, step_between
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, pose_slice
from sigmaslam.estimation.window_state import loop_difference
from sigmaslam.geometry.se3 import se3_body, se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.slam.point_map import PointMap, hand_over_points, merge_maps, most_confirmed, points_in_world
from tests.support.dense_window import (
    CALIBRATION_SIGMA,
    DEPTH,
    KEYFRAMES,
    NARROW,
    NO_WALK,
    Dense,
    dense_slice,
    in_sigmas,
    make_window,
    unsolved,
    without_considered,
    world,
)
from tests.support.pose_graph import PoseEdge, optimise_pose_graph

STEP_SIGMA = 1e-3 * np.array([0.02, 0.02, 0.02, 0.003, 0.003, 0.003])
LOOP_SIGMA = STEP_SIGMA / 2
COUNT = 12


def joint(window: KeyframeWindow) -> np.ndarray:
    """Covariance of the estimated calibration, past poses, and poses of the window."""
    past = window.posterior.past
    whole = np.block([[window.posterior.covariance, past.cross.T], [past.cross, past.covariance]])
    size = len(window.posterior.covariance)
    order = np.r_[CALIBRATION, size : len(whole), CALIBRATION_SIZE:size]
    return without_considered(whole[np.ix_(order, order)])


def drive(seed: int) -> tuple[np.ndarray, list[PoseEdge]]:
    """True poses once around, and measured steps."""
    rng = np.random.default_rng(seed)
    step = se3_exp(np.array([0, 0, 1.0, 0, 2 * np.pi / COUNT, 0]))
    truth = np.stack([np.linalg.matrix_power(step, k) for k in range(COUNT)])
    steps = [
        PoseEdge(k, k + 1, step @ se3_exp(STEP_SIGMA * rng.normal(size=6)), np.diag(STEP_SIGMA**2))
        for k in range(COUNT - 1)
    ]
    return truth, steps


def follow(steps: list[PoseEdge], kept: int = 3) -> KeyframeWindow:
    """A window that knows the steps alone."""
    window = make_window(CALIBRATION_SIGMA)
    window.add_keyframe(np.eye(4), np.eye(4), np.zeros((6, 6)), NO_WALK, DEPTH)
    for step in steps:
        if len(window) == kept:
            window.marginalise_oldest()
        pose = window.posterior.poses[-1] @ step.T_i_j
        window.add_keyframe(pose, step.T_i_j, turn_covariance(pose, step.covariance), NO_WALK, DEPTH)
        window.solve()
    return window


def close(window: KeyframeWindow, edge: PoseEdge) -> bool:
    match = turn_covariance(window.posterior.past.poses[edge.i] @ edge.T_i_j, edge.covariance)
    return window.add_loop_constraint(edge.i, edge.T_i_j, match)


def loop(truth: np.ndarray, i: int, seed: int) -> PoseEdge:
    """The last pose as an early one sees it."""
    error = se3_exp(LOOP_SIGMA * np.random.default_rng(100 + seed).normal(size=6))
    return PoseEdge(i, COUNT - 1, se3_inverse(truth[i]) @ truth[-1] @ error, np.diag(LOOP_SIGMA**2), doubtful=True)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_past_and_window_together_are_the_dense_solution(seed: int):
    """One keyframe has left, some of its landmarks' views are in the prior, the other views in the window."""
    given = world(seed, NARROW, count=30)
    window = unsolved(given)
    window.solve(8)
    window.marginalise_oldest()
    window.solve(8)
    dense = Dense(given, KEYFRAMES).solve()
    assert in_sigmas(joint(window), dense.covariance()) < 1e-3
    error = se3_log(window.posterior.past.poses[0] @ se3_inverse(dense.poses[0]))
    assert np.abs(error / np.sqrt(np.diag(dense.covariance())[dense_slice(0)])).max() < 1e-3


def test_a_loop_that_another_confirms_scales_what_it_contradicts():
    """By the variance of unit weight: the same loop to steps that claim so much less closes it the same way."""
    truth, steps = drive(0)
    aside = se3_exp(np.array([0.004, 0.0, 0.0, 0.0, 0.0, 0.0]))
    edge = loop(truth, 1, 0)
    edge = replace(edge, T_i_j=edge.T_i_j @ aside)
    window = follow(steps)
    match = turn_covariance(window.posterior.past.poses[1] @ edge.T_i_j, edge.covariance)
    difference = loop_difference(window.posterior, 1, edge.T_i_j)
    known = window.posterior.past.relative_to(window.posterior.covariance, window.posterior.common, 1)
    factor = difference @ np.linalg.solve(known + match, difference) / 6
    assert factor > 5.0
    before = joint(window)
    assert not window.add_loop_constraint(1, edge.T_i_j, match)
    np.testing.assert_array_equal(joint(window), before)
    assert window.add_loop_constraint(1, edge.T_i_j, match, confirmed=True)
    wider = follow([replace(step, covariance=factor * step.covariance) for step in steps])
    assert wider.add_loop_constraint(1, edge.T_i_j, match)
    np.testing.assert_allclose(window.posterior.poses, wider.posterior.poses, atol=1e-7)
    np.testing.assert_allclose(
        joint(window)[6:, 6:], joint(wider)[6:, 6:], atol=1e-3 * np.abs(joint(wider)[6:, 6:]).max()
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_corrects_all_poses_as_a_pose_graph_does(seed: int):
    pytest.importorskip("gtsam")
    truth, steps = drive(seed)
    window, edge = follow(steps), loop(truth, 1, seed)
    before = np.concatenate([window.posterior.past.poses, window.posterior.poses])
    graph = optimise_pose_graph(before, [*steps, edge])
    assert graph.used.all()
    assert close(window, edge)
    after = np.concatenate([window.posterior.past.poses, window.posterior.poses])
    whole = joint(window)[3:, 3:]
    for k in range(1, COUNT):
        own = slice(6 * k, 6 * k + 6)
        covariance = se3_body(after[k], whole[own, own])
        assert in_sigmas(covariance, graph.covariances[k]) < 1e-2
        error = se3_log(se3_inverse(after[k]) @ graph.poses[k])
        assert np.abs(error / np.sqrt(np.diag(graph.covariances[k]))).max() < 1e-2
    # A second one from where the first has led to.
    second = loop(truth, 4, seed + 50)
    graph = optimise_pose_graph(after, [*steps, edge, second])
    second_window = np.trace(window.posterior.past.covariance)
    if close(window, second):
        np.testing.assert_allclose(window.posterior.past.poses, graph.poses[: len(window.posterior.past)], atol=1e-6)
        assert np.trace(window.posterior.past.covariance) < second_window


@pytest.mark.long
def test_errors_are_as_large_as_the_covariance_says_after_a_loop():
    ratios = []
    for seed in range(30):
        truth, steps = drive(seed)
        window = follow(steps)
        assert close(window, loop(truth, 1, seed))
        for k in (3, 6):
            error = se3_log(truth[k] @ se3_inverse(window.posterior.past.poses[k]))
            own = slice(6 * k, 6 * k + 6)
            ratios.append(error @ np.linalg.solve(window.posterior.past.covariance[own, own], error) / 6)
    # Standard deviation of the mean: 0.07, more as far as the two poses err alike.
    assert 0.75 < np.mean(ratios) < 1.25


def arrays_of(window: KeyframeWindow) -> list[np.ndarray]:
    state = window.posterior
    return [state.poses, state.covariance, state.past.poses, state.past.covariance, state.past.cross]


def test_a_wrong_loop_is_refused_and_changes_nothing():
    truth, steps = drive(0)
    window, edge = follow(steps), loop(truth, 1, 0)
    before = arrays_of(window)
    wrong = replace(edge, T_i_j=edge.T_i_j @ se3_exp(np.array([0.003, 0, -0.002, 0, 0.0005, 0])))
    assert not close(window, wrong)
    after = arrays_of(window)
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


def test_the_same_loop_again_says_nothing_new():
    truth, steps = drive(0)
    window, edge = follow(steps), loop(truth, 1, 0)
    assert close(window, edge)
    assert not close(window, edge)


def test_forgetting_a_pose_leaves_the_others_as_they_were():
    truth, steps = drive(0)
    window, other = follow(steps), follow(steps)
    window.forget_past(5)
    edge = loop(truth, 1, 0)
    assert close(window, edge)
    assert close(other, edge)
    np.testing.assert_allclose(window.posterior.poses, other.posterior.poses, atol=1e-12)
    np.testing.assert_allclose(window.posterior.past.poses, other.posterior.past.drop(5).poses, atol=1e-12)
    np.testing.assert_allclose(
        window.posterior.past.covariance, other.posterior.past.drop(5).covariance, rtol=1e-6, atol=1e-18
    )


def test_a_new_start_from_a_past_pose_knows_what_it_has_in_common_with_it():
    _, steps = drive(0)
    window = follow(steps)
    while len(window):
        window.marginalise_oldest()
    pose, match = window.posterior.past.poses[4] @ steps[0].T_i_j, np.diag(LOOP_SIGMA**2)
    window.add_keyframe(pose, pose, match, NO_WALK, DEPTH, 4)
    window.solve()
    own, last = slice(24, 30), pose_slice(0)
    across = window.posterior.past.cross[own, last]
    relative = window.posterior.covariance[last, last] + window.posterior.past.covariance[own, own] - across - across.T
    np.testing.assert_allclose(relative, match, atol=1e-15)


# ---- points that hang at them


def chained(count: int) -> PastPoses:
    """Poses a metre apart, each step as uncertain as the other."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    blocks = np.minimum.outer(np.arange(count), np.arange(count))
    none = np.zeros((6 * count, CALIBRATION_SIZE))
    return PastPoses(poses, np.kron(blocks, 1e-4 * np.eye(6)), none, none)


def some_points(count: int, views: int) -> PointMap:
    rng = np.random.default_rng(count)
    points = rng.uniform(1, 3, (count, 3))
    covariances, times = np.tile(1e-6 * np.eye(3), (count, 1, 1)), np.zeros(count)
    return PointMap(points, covariances, np.full(count, views), times, points[:, :2], np.zeros(count, np.float32))


def test_points_move_with_their_keyframe():
    past, parts = chained(3), [some_points(count, 3) for count in (4, 5, 6)]
    moved = replace(past, poses=np.array([np.eye(4), se3_exp(np.array([0, 0, 0, 0, 0.1, 0])), np.eye(4)]) @ past.poses)
    before, after = points_in_world(parts, past).points, points_in_world(parts, moved).points
    changed = np.linalg.norm(after - before, axis=1) > 1e-9
    assert changed.tolist() == [False] * 4 + [True] * 5 + [False] * 6
    np.testing.assert_allclose(after[4:9], before[4:9] @ se3_exp(np.array([0, 0, 0, 0, 0.1, 0]))[:3, :3].T, atol=1e-12)


def test_points_of_a_forgotten_keyframe_stay_and_hang_at_the_closest_one():
    past, parts = chained(4), [some_points(count, 3) for count in (4, 5, 6, 7)]
    before = points_in_world(parts, past)
    assert past.closest(3) == 2
    inherited = merge_maps([parts[2], hand_over_points(parts[3], *step_between(past, 2, 3))])
    after = points_in_world([*parts[:2], inherited], past.drop(3))
    assert len(after) == 22
    np.testing.assert_allclose(after.points, before.points, atol=1e-12)
    # Of a chain the covariances are the same whichever way round.
    np.testing.assert_allclose(after.covariances, before.covariances, rtol=1e-9, atol=1e-15)


def test_the_map_keeps_what_most_views_confirm():
    parts = [some_points(6, views) for views in (3, 9, 5, 4)]
    kept = most_confirmed(parts, 10)
    assert [len(part) for part in kept] == [0, 6, 4, 0]
    assert sorted(merge_maps(kept).observations.tolist()) == [5] * 4 + [9] * 6

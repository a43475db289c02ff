"""Pose graphs: what a loop gains, covariances against dense algebra, wrong loops."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.bundle_adjustment.solver import connected_parts
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse, se3_log
from tests.support.pose_graph import PoseEdge, optimise_pose_graph
from tests.support.quantiles import squared_sigmas

STEP_SIGMA = np.array([0.02, 0.02, 0.02, 0.003, 0.003, 0.003])
LOOP_SIGMA = STEP_SIGMA / 2


pytest.importorskip("gtsam")


def circle(count: int = 60, radius: float = 10.0) -> np.ndarray:
    """Poses once around, looking ahead; the next step would lead back to the first."""
    step = se3_exp(np.array([0, 0, 2 * np.pi * radius / count, 0, 2 * np.pi / count, 0]))
    return np.stack([np.linalg.matrix_power(step, k) for k in range(count)])


def measure(
    poses: np.ndarray, i: int, j: int, sigma: np.ndarray, rng: np.random.Generator, doubtful: bool = False
) -> PoseEdge:
    noise = se3_exp(rng.normal(size=6) * sigma)
    return PoseEdge(i, j, se3_inverse(poses[i]) @ poses[j] @ noise, np.diag(sigma**2), doubtful)


def drive(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray, list[PoseEdge]]:
    """True poses, the poses of dead reckoning, and its edges."""
    rng = np.random.default_rng(seed)
    truth = circle(count)
    steps = [measure(truth, k, k + 1, STEP_SIGMA, rng) for k in range(count - 1)]
    reckoned = [truth[0]]
    for step in steps:
        reckoned.append(reckoned[-1] @ step.T_i_j)
    return truth, np.stack(reckoned), steps


def loop(truth: np.ndarray, seed: int, i: int, j: int) -> PoseEdge:
    return measure(truth, i, j, LOOP_SIGMA, np.random.default_rng(1000 + seed), doubtful=True)


def wrong(edge: PoseEdge) -> PoseEdge:
    return replace(edge, T_i_j=edge.T_i_j @ se3_exp(np.array([3.0, 0, -2.0, 0, 0.5, 0])))


def nees(truth: np.ndarray, poses: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    return squared_sigmas(se3_log(se3_inverse(poses) @ truth), covariances)


def dense_covariances(poses: np.ndarray, edges: list[PoseEdge]) -> np.ndarray:
    """Inverse of the normal matrix, all but the first pose, perturbed from the right."""
    normal = np.zeros((6 * len(poses), 6 * len(poses)))
    for edge in edges:
        # log(T^-1 T_i^-1 T_j) changes by the change of j, less that of i seen from j.
        jacobian = np.zeros((6, 6 * len(poses)))
        jacobian[:, 6 * edge.i : 6 * edge.i + 6] = -se3_adjoint(se3_inverse(poses[edge.j]) @ poses[edge.i])
        jacobian[:, 6 * edge.j : 6 * edge.j + 6] = np.eye(6)
        normal += jacobian.T @ np.linalg.solve(edge.covariance, jacobian)
    full = np.linalg.inv(normal[6:, 6:])
    return np.stack([full[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(poses) - 1)])


def test_exact_edges_give_the_exact_poses_back():
    truth = circle()
    rng = np.random.default_rng(0)
    none = np.zeros(6)
    edges = [replace(measure(truth, k, k + 1, none, rng), covariance=np.eye(6)) for k in range(59)]
    edges.append(replace(measure(truth, 59, 0, none, rng, True), covariance=np.eye(6)))
    start = truth @ np.concatenate([np.eye(4)[None], se3_exp(rng.normal(0, 0.1, (59, 6)))])
    result = optimise_pose_graph(start, edges)
    np.testing.assert_allclose(result.poses, truth, atol=1e-9)
    assert result.used.all()


def test_without_a_loop_the_poses_are_those_of_dead_reckoning():
    _, reckoned, steps = drive(0)
    np.testing.assert_allclose(optimise_pose_graph(reckoned, steps).poses, reckoned, atol=1e-9)


@pytest.mark.long
def test_a_loop_takes_as_much_error_from_the_end_as_the_covariances_say():
    before, after, expected = [], [], []
    for seed in range(40):
        truth, reckoned, steps = drive(seed)
        open_result = optimise_pose_graph(reckoned, steps)
        result = optimise_pose_graph(reckoned, [*steps, loop(truth, seed, 59, 0)])
        assert result.used.all()
        before.append(np.sum((reckoned[-1] - truth[-1])[:3, 3] ** 2))
        after.append(np.sum((result.poses[-1] - truth[-1])[:3, 3] ** 2))
        expected.append(np.trace(result.covariances[-1][:3, :3]) / np.trace(open_result.covariances[-1][:3, :3]))
    # Of 40 runs with about two degrees of freedom each: within a factor of 1.5.
    factor = np.sum(after) / np.sum(before)
    assert np.mean(expected) < 2e-3
    assert np.mean(expected) / 1.5 < factor < 1.5 * np.mean(expected)


@pytest.mark.long
def test_errors_are_as_large_as_the_covariances_say():
    ratios = []
    for seed in range(40):
        truth, reckoned, steps = drive(seed)
        result = optimise_pose_graph(reckoned, [*steps, loop(truth, seed, 59, 0)])
        ratios.append(nees(truth[1:], result.poses[1:], result.covariances[1:])[[15, 30, 45, 58]].mean() / 6)
    # The standard deviation of the mean of 40 is about 0.05.
    assert 0.85 < np.mean(ratios) < 1.15


def test_covariances_equal_those_of_dense_algebra():
    truth, reckoned, steps = drive(1)
    edges = [*steps, loop(truth, 1, 59, 0), loop(truth, 2, 40, 10)]
    result = optimise_pose_graph(reckoned, edges)
    dense = dense_covariances(result.poses, edges)
    # The dense one leaves out how the log bends with the residual, which is of the order of its size.
    np.testing.assert_allclose(result.covariances[1:], dense, rtol=0.02, atol=0.02 * np.abs(dense).max())
    assert not result.covariances[0].any()
    exact = [replace(edge, T_i_j=se3_inverse(truth[edge.i]) @ truth[edge.j]) for edge in edges]
    result = optimise_pose_graph(truth, exact)
    np.testing.assert_allclose(result.covariances[1:], dense_covariances(truth, exact), rtol=1e-5, atol=1e-11)


def test_the_covariance_of_the_first_pose_is_carried_to_the_others():
    truth, reckoned, steps = drive(2)
    first = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
    first[2, 4] = first[4, 2] = 1e-3
    edges = [*steps, loop(truth, 2, 59, 0)]
    fixed, loose = optimise_pose_graph(reckoned, edges), optimise_pose_graph(reckoned, edges, first)
    np.testing.assert_array_equal(fixed.poses, loose.poses)
    np.testing.assert_allclose(loose.covariances[0], first, atol=1e-15)
    # A second way: the first pose as a step from one that is fixed.
    shifted = [replace(edge, i=edge.i + 1, j=edge.j + 1) for edge in edges]
    chain = optimise_pose_graph(np.concatenate([reckoned[:1], reckoned]), [PoseEdge(0, 1, np.eye(4), first), *shifted])
    np.testing.assert_allclose(loose.covariances, chain.covariances[1:], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_wrong_loop_is_switched_off(seed: int):
    truth, reckoned, steps = drive(seed)
    bad = wrong(loop(truth, seed, 59, 0))
    result = optimise_pose_graph(reckoned, [*steps, bad])
    assert not result.used[-1]
    assert result.used[:-1].all()
    np.testing.assert_allclose(result.poses, reckoned, atol=1e-6)

    good = [loop(truth, seed, 58, 1), loop(truth, seed + 1, 40, 5)]
    result = optimise_pose_graph(reckoned, [*steps, good[0], bad, good[1]])
    np.testing.assert_array_equal(result.used[-3:], [True, False, True])
    without = optimise_pose_graph(reckoned, [*steps, *good])
    np.testing.assert_allclose(result.poses, without.poses, atol=1e-6)
    np.testing.assert_allclose(result.covariances, without.covariances, rtol=1e-4, atol=1e-10)


def test_two_runs_are_equal_to_the_bit():
    truth, reckoned, steps = drive(3)
    edges = [*steps, loop(truth, 3, 59, 0), wrong(loop(truth, 3, 30, 2))]
    first, second = optimise_pose_graph(reckoned, edges), optimise_pose_graph(reckoned, edges)
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()


def test_one_pose_alone_stays():
    result = optimise_pose_graph(np.eye(4)[None], [], np.eye(6))
    np.testing.assert_array_equal(result.poses[0], np.eye(4))
    np.testing.assert_array_equal(result.covariances[0], np.eye(6))


def test_bad_graphs_are_refused_with_their_place():
    truth, reckoned, steps = drive(0)
    with pytest.raises(ValueError, match="1 of 60 poses, the first is 59, are not connected"):
        optimise_pose_graph(reckoned, [*steps[:-1], loop(truth, 0, 59, 0)])
    with pytest.raises(ValueError, match="edge 1, from 5 to 60, must join"):
        optimise_pose_graph(reckoned, [steps[0], replace(steps[1], i=5, j=60)])
    with pytest.raises(ValueError, match=r"edge 0.* not positive definite"):
        optimise_pose_graph(reckoned, [replace(steps[0], covariance=np.zeros((6, 6))), *steps[1:]])
    with pytest.raises(ValueError, match=r"must be \(K, 4, 4\)"):
        optimise_pose_graph(reckoned[0], steps)


def test_the_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(InputError, match=r"gtsam is not installed: pip install 'sigmaslam\[graph\]'"):
        optimise_pose_graph(np.eye(4)[None], [])


def test_connected_parts_are_named_after_their_lowest_member():
    np.testing.assert_array_equal(connected_parts(6, [(4, 2), (5, 4), (1, 0)]), [0, 0, 2, 3, 2, 2])

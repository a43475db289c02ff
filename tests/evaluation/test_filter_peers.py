"""Every library that is installed does the work of the benchmark and nothing else."""

import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from sigmaslam_benchmarks.filters import peer_filters as filter_peers
from sigmaslam_benchmarks.filters import work as filter_work
from sigmaslam_benchmarks.filters.peer_filters import PEERS, Peer
from sigmaslam_benchmarks.filters.work import Belief, StereoWork, Work

WORKS: tuple[Work, ...] = (
    filter_work.stereo(4, seed=1),
    filter_work.localisation(20, seed=1),
    filter_work.position(5, seed=1),
    filter_work.landmark(5, seed=1),
    filter_work.linear(5, seed=1),
)
CASES = [
    (peer, work, dtype) for peer in PEERS for work in WORKS if isinstance(work, peer.works) for dtype in peer.dtypes
]
CASE_NAMES = [f"{peer.name}-{type(work).__name__}-{dtype}" for peer, work, dtype in CASES]


def gap(result: Belief, expected: Belief) -> float:
    """Largest difference of means in sigmas, and of covariances as correlations."""
    sigma = np.sqrt(np.diagonal(expected[1], axis1=-2, axis2=-1))
    scale = sigma[..., :, None] * sigma[..., None, :]
    of_mean, of_covariance = np.abs(result[0] - expected[0]) / sigma, np.abs(result[1] - expected[1]) / scale
    return float(max(of_mean.max(), of_covariance.max()))


def tolerance(peer: Peer, work: Work, dtype: str) -> float:
    if dtype == "float32":
        # P - K S K^T cancels: the stereo posterior is far smaller than the prior.
        return 1e-2 if isinstance(work, StereoWork) else 1e-3
    if peer.name == "dynamax":
        # It adds 1e-9 to S, to be compared with the bearing's variance of 1e-4.
        return 1e-4
    return 1e-6 if isinstance(work, StereoWork) else 1e-10


@pytest.mark.parametrize(("peer", "work", "dtype"), CASES, ids=CASE_NAMES)
def test_peer_equals_numpy_reference(peer: Peer, work: Work, dtype: str) -> None:
    for module in peer.modules:
        pytest.importorskip(module)
    if peer.name.startswith("PyPose") and isinstance(work, StereoWork) and dtype == "float32":
        pytest.skip("its covariance is noise in float32, as its docstring says")
    step = peer.make(work, dtype)
    first = step()
    assert first[0].dtype == first[1].dtype == dtype
    assert first[0].shape == work.mean.shape
    assert first[1].shape == work.covariance.shape
    assert gap(first, filter_work.step(work)) < tolerance(peer, work, dtype)
    # The prior is left as it was: a step can be timed again and again.
    for again, before in zip(step(), first, strict=True):
        np.testing.assert_array_equal(again, before)


def step_stereo_dense(work: filter_work.StereoWork) -> filter_work.Belief:
    """One step with the textbook update: S = Z Z^T + R of size 4m is formed and solved."""
    return filter_work._update(
        *filter_work._predict(
            work.mean, work.covariance, lambda states: filter_work.advance(states, work.transition), work.process_noise
        ),
        lambda states: filter_work.project_stereo(np, states, work.points),
        work.measurement_noise,
        work.measurement,
    )


@pytest.mark.parametrize("m", [1, 5, 30])
def test_low_rank_reference_equals_dense(m: int) -> None:
    work = filter_work.stereo(m, seed=m)
    low_rank, dense = filter_work.step_stereo_low_rank(work), step_stereo_dense(work)
    assert gap(dense, low_rank) < 1e-6
    np.testing.assert_allclose(dense[1], low_rank[1], rtol=0.0, atol=1e-12)


def test_work_is_the_same_for_the_same_seed() -> None:
    one, two, other = (filter_work.localisation(3, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.measurement, two.measurement)
    assert not np.array_equal(one.measurement, other.measurement)


def test_bearings_of_the_work_wrap() -> None:
    work = filter_work.localisation(20, seed=1)
    unwrapped = filter_work.range_and_bearing(np, filter_work.drive(np, work.mean, work.control), work.landmark)
    assert np.any(np.abs(work.measurement[:, 1] - unwrapped[:, 1]) > np.pi)


@pytest.mark.parametrize("seed", range(3))
def test_truth_is_as_far_as_the_posterior_says(seed: int) -> None:
    """The residuals of the position fix, squared by their covariance, have the mean of chi-squared."""
    work = filter_work.position(300, seed)
    mean, covariance = filter_work.step(work)
    # The residual after the update has covariance R - P in the position.
    residual = work.measurement - mean[:, :2]
    S = work.measurement_noise - covariance[:, :2, :2]
    squared = np.einsum("bi,bij,bj->b", residual, np.linalg.inv(S), residual)
    assert abs(squared.mean() - 2.0) < 4 * np.sqrt(4.0 / 300)


def test_stone_soup_does_not_remember_its_last_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stonesoup")
    calls = []

    def counted(xp: object, states: object, control: object) -> object:
        calls.append(1)
        return filter_work.drive(xp, states, control)

    monkeypatch.setattr(filter_peers, "drive", counted)
    step = filter_peers.stone_soup(filter_work.position(1, seed=0))
    step()
    step()
    assert len(calls) == 2


def test_halves_of_dynamax_are_its_public_filter() -> None:
    """unscented_kalman_filter() updates first: given our prediction, one emission makes our posterior."""
    inference = pytest.importorskip("dynamax.nonlinear_gaussian_ssm")
    jax = pytest.importorskip("jax")
    work = filter_work.position(1, seed=0)
    mean, covariance = filter_work._predict(
        work.mean[0],
        work.covariance[0],
        lambda states: filter_work.drive(np, states, work.control[0]),
        work.process_noise,
    )
    with jax.enable_x64(True):
        posterior = inference.unscented_kalman_filter(
            inference.ParamsNLGSSM(
                initial_mean=jax.numpy.asarray(mean),
                initial_covariance=jax.numpy.asarray(covariance),
                dynamics_function=lambda state: state,
                dynamics_covariance=jax.numpy.asarray(work.process_noise),
                emission_function=lambda state: state[:2],
                emission_covariance=jax.numpy.asarray(work.measurement_noise),
            ),
            jax.numpy.asarray(work.measurement),
            inference.UKFHyperParams(alpha=1.0, beta=0.0, kappa=0.0),
        )
    result = np.asarray(posterior.filtered_means), np.asarray(posterior.filtered_covariances)
    assert gap(result, filter_peers.dynamax(work)()) < 1e-10


def test_pypose_as_it_is_needs_the_repair() -> None:
    """If this fails, PyPose has mended itself: compare it as it is."""
    pytest.importorskip("pypose")
    work = filter_work.stereo(4, seed=1)
    assert gap(filter_peers.pypose(work, repaired=False)(), filter_work.step(work)) > 1.0
    batch = filter_work.position(5, seed=1)
    with pytest.raises(RuntimeError, match="size of tensor"):
        filter_peers.pypose(batch, repaired=False)()


def test_unscented_peer_refuses_linear_work() -> None:
    pytest.importorskip("torch")
    with pytest.raises(TypeError, match="Kalman"):
        filter_peers.torch_linalg(filter_work.linear(1, seed=0))


def test_unknown_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="float64"):
        filter_peers.filterpy(WORKS[0], "float32")


def test_available_lists_what_is_installed() -> None:
    names = {peer.name for peer in filter_peers.available()}
    assert ("torch-kf" in names) == (find_spec("torch_kf") is not None)
    assert ("torch.linalg batched" in names) == (find_spec("torch") is not None)


@pytest.mark.long
def test_environment_leaves_torch_one_thread() -> None:
    pytest.importorskip("torch")
    printed = subprocess.run(
        [sys.executable, "-c", "import torch; print(torch.get_num_threads())"],
        env=filter_peers.single_thread_environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.strip() == "1"

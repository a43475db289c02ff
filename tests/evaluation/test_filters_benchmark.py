"""The benchmark of the filters times the right work."""

from itertools import pairwise

import numpy as np
import pytest

from sigmaslam_benchmarks.filters import extended, sequences
from sigmaslam_benchmarks.filters import ours as filter_ours
from sigmaslam_benchmarks.filters import work as filter_work
from sigmaslam_benchmarks.filters.peer_filters import PEERS
from sigmaslam_benchmarks.filters.speed import KINDS, Contender, Timing, batch_contenders, time_interleaved
from sigmaslam_filters import SE3, Euclidean


@pytest.mark.parametrize("points", [3, 30])
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-8), ("float32", 1e-2)])
def test_our_stereo_step_is_the_references(points: int, dtype: str, tolerance: float):
    work = filter_work.stereo(points, seed=1)
    check(work, filter_work.step_stereo_low_rank(work), dtype, tolerance)


@pytest.mark.parametrize("kind", ["localisation", "position", "landmark", "linear"])
@pytest.mark.parametrize("batch", [1, 150])
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-3)])
def test_our_batched_step_is_the_references(kind: str, batch: int, dtype: str, tolerance: float):
    work = getattr(filter_work, kind)(batch, seed=1)
    check(work, filter_work.step_loop(work), dtype, tolerance)


@pytest.mark.parametrize("kind", KINDS)
def test_numpy_has_a_row_that_steps_the_whole_batch_at_once(kind: str):
    """The reference beside it is a loop, and stops at a thousand filters."""
    batch, seed = 1200, 0  # the benchmark's seed
    peers = [peer for peer in PEERS if peer.modules == ("numpy",)]
    rows = {contender.name: (contender, size) for contender, size in batch_contenders(kind, batch, peers, False)}
    batched, size = rows["numpy batched"]
    assert (rows["plain numpy"][1], size) == (1000, batch)
    mean, covariance = batched.step()
    expected = filter_work.step_loop(getattr(filter_work, kind)(batch, seed))
    sigma = np.sqrt(np.diagonal(expected[1], axis1=-2, axis2=-1))
    assert np.abs((mean - expected[0]) / sigma).max() < 1e-9
    assert np.abs((covariance - expected[1]) / (sigma[..., :, None] * sigma[..., None, :])).max() < 1e-9


@pytest.mark.parametrize("kind", extended.KINDS)
@pytest.mark.parametrize("batch", [1, 150])
def test_extended_and_unscented_filters_do_the_same_work(kind: str, batch: int):
    """With a prior of 0.1 their means are apart by a small part of it."""
    found, expected = (step() for step in extended.KINDS[kind](batch).values())
    assert found.mean.shape == expected.mean.shape
    space = SE3() if kind == "SE(3)" else Euclidean(3)
    moved = space.local(expected.mean, found.mean).abs()
    assert 0.0 < float(moved.median()) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 70])
def test_sequences_are_filtered_alike_however_they_are_compiled(batch: int):
    expected, *others = (filtered() for filtered in sequences.make(batch, steps=5).values())
    assert expected[0].shape == ((5, 3) if batch == 1 else (5, 70, 3))
    for found in others:
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def check(work: filter_work.Work, expected: filter_work.Belief, dtype: str, tolerance: float) -> None:
    """Mean and covariance agree, in units of the posterior's standard deviations."""
    found = filter_ours.make(work, dtype)()
    mean, covariance = expected
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    assert np.abs((found.mean.numpy() - mean) / sigma).max() < tolerance
    scale = sigma[..., :, None] * sigma[..., None, :]
    assert np.abs((found.covariance.numpy() - covariance) / scale).max() < tolerance


def test_contenders_take_turns():
    calls: list[str] = []
    contenders = [Contender(name, lambda name=name: calls.append(name)) for name in "ab"]
    timings = time_interleaved(contenders, rounds=3)
    assert [len(timing.seconds) for timing in timings.values()] == [3, 3]
    order = [calls[0]] + [after for before, after in pairwise(calls) if before != after]
    assert "".join(order) == "ab" * 4  # once to warm up, and three rounds


def test_ratio_is_taken_round_by_round():
    assert Timing([2.0, 4.0, 9.0]).ratio(Timing([1.0, 4.0, 3.0])) == (2.0, 1.0, 3.0)

"""Sequences of events of several kinds, compiled: what filter_events does, and its derivatives."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters import Event, systems
from sigmaslam_filters.compiler.scalar_sequence import CompiledStep
from tests.support.examples import load_example
from tests.support.filter_assertions import assert_close, assert_same_belief
from tests.support.filter_builders import beliefs, bent_motion, covariances, random_numbers, tensor

EYE = torch.eye(2, dtype=torch.float64)
SPEED = filters.LinearMeasurement(tensor(0.0, 1.0)[None], tensor(0.01)[None])


@pytest.fixture(autouse=True)
def nothing_compiled_before():
    torch._dynamo.reset()


WIDE = filters.LinearMeasurement(random_numbers(2, 2, seed=5), covariances(2, seed=6))


def move(seconds: float) -> filters.LinearMotion:
    A = torch.tensor([[1.0, seconds], [0.0, 1.0]], dtype=torch.float64)
    return filters.LinearMotion(A, seconds * EYE)


MOTIONS = [move(0.1 + 0.1 * k) for k in range(6)]
MASKED = filters.LinearMeasurement(WIDE.matrix, WIDE.noise, mask=torch.tensor([True, False]))


def events(*batch: int) -> list[Event]:
    """Motions that change with time, a mask, missing components, a gate, robust weights, a forecast."""
    values = random_numbers(8, *batch, 2, seed=3)
    values[4] = 40.0
    values[2, ..., 1] = torch.nan
    return [
        Event(None, WIDE, values[0]),
        Event(MOTIONS[0], SPEED, values[1, ..., :1]),
        Event(MOTIONS[1], WIDE, values[2], robust="student_t"),
        Event(MOTIONS[2]),
        Event(MOTIONS[3], WIDE, values[4], gate=0.999),
        Event(MOTIONS[4], MASKED, values[5]),
        Event(MOTIONS[5], SPEED, values[6, ..., :1]),
    ]


def assert_same_track(found: filters.Track, expected: filters.Track, tolerance: float = 1e-12) -> None:
    assert_same_belief(found.predicted, expected.predicted, tolerance)
    assert_same_belief(found.filtered, expected.filtered, tolerance)
    for name in ("innovation", "nis", "log_likelihood"):
        assert_close(getattr(found, name), getattr(expected, name), 100 * tolerance)
    assert torch.equal(found.count, expected.count)
    assert torch.equal(found.healthy, expected.healthy)


@pytest.mark.slow
def test_events_of_many_kinds_equal_filter_events_and_can_be_smoothed():
    kf = filters.KalmanFilter()
    fast = filters.compile_filter(kf)
    for batch in ((), (3,)):
        given, prior = events(*batch), beliefs(*batch, 2)
        found, expected = fast.filter_events(prior, given), kf.filter_events(prior, given)
        assert_same_track(found, expected)
        assert found.count[4].sum() == 0
        assert_same_belief(kf.smooth(found), kf.smooth(expected), 1e-12)
        assert_same_belief(kf.smooth(found, lag=2), kf.smooth(expected, lag=2), 1e-12)
        # Other batches are of the same kinds.
        assert len(fast._scalar_steps) == 6
    assert all(isinstance(step, CompiledStep) for step in fast._scalar_steps.values())
    # Motions of other times are of the kinds that are there; a late event is filtered from the belief before it.
    late = [Event(move(0.05), SPEED, tensor(0.3)), Event(move(0.15), SPEED, tensor(0.2)), *events()[2:]]
    found = fast.filter_events(expected.filtered[0, 0], late)
    assert_same_track(found, kf.filter_events(expected.filtered[0, 0], late))
    assert len(fast._scalar_steps) == 6


def swing(state: Tensor, seconds: Tensor) -> Tensor:
    """A pendulum's angle and rate."""
    dt = seconds[..., 0]
    return filters.stack([state[..., 0] + state[..., 1] * dt, state[..., 1] - 9.81 * torch.sin(state[..., 0]) * dt])


def shadow(state: Tensor) -> Tensor:
    return torch.sin(state[..., :1])


@pytest.mark.slow
@pytest.mark.parametrize("make", [filters.UnscentedKalmanFilter, filters.ExtendedKalmanFilter])
def test_gradients_of_the_likelihood_are_those_of_filter_events(make):
    """By noises, the prior, values and inputs, with what is missing and refused."""
    bayes = make(iterations=1)
    fast = filters.compile_filter(bayes)
    values, steps = 0.5 * random_numbers(12, 1), 0.05 + 0.05 * random_numbers(12, 1, seed=1).abs()
    values[4], values[7] = torch.nan, 30.0
    given = [tensor(-4.0, -3.0, -2.0), beliefs(2).mean, covariances(2, seed=1), values, steps]
    found = []
    for filtered in (fast.filter_events, bayes.filter_events):
        leaves = [each.clone().requires_grad_() for each in given]
        noise, mean, covariance, seen, seconds = leaves
        motion = filters.MotionModel(swing, filters.Diagonal(noise[:2].exp()))
        see = filters.MeasurementModel(shadow, filters.Diagonal(noise[2:].exp()))
        sequence = [
            Event(motion if k else None, see, seen[k], seconds[k] if k else (), gate=0.999, robust="student_t")
            for k in range(12)
        ]
        track = filtered(filters.Gaussian(mean, covariance), sequence)
        total = track.log_likelihood.sum() + track.filtered.mean[5:].square().sum() + track.predicted.covariance.sum()
        found.append([total, *torch.autograd.grad(total, leaves)])
    # A covariance's gradient is read off one triangle or both.
    for each in found:
        each[3] = each[3] + each[3].mT
    for a, b in zip(*found, strict=True):
        assert_close(a.nan_to_num(0.0), b.nan_to_num(0.0), 1e-10)
    assert float(found[0][1].abs().min()) > 0.0


@pytest.mark.slow
def test_streams_are_events_in_their_order_for_large_batches_too(caplog):
    see, motion = filters.MeasurementModel(lambda x: x[..., :1], tensor(0.1)[None]), bent_motion(2)
    order = torch.tensor([0, 1, 1, 0, 1])
    kf, ukf = filters.KalmanFilter(), filters.UnscentedKalmanFilter(iterations=1)
    for batch in ((2,), (40,)):
        streams = [Event(motion, see, random_numbers(2, *batch, 1)), Event(None, SPEED, random_numbers(3, *batch, 1))]
        fast = filters.compile_filter(ukf)
        with caplog.at_level(logging.INFO, "sigmaslam_filters"):
            found = fast.filter_streams(beliefs(2), streams, order)
        assert_same_track(found, ukf.filter_events(beliefs(2), filters.interleaved(streams, order)), 1e-11)
        assert bool(fast._steps) == (batch == (40,))
        assert_same_belief(
            ukf.smooth(found), ukf.smooth(ukf.filter_events(beliefs(2), filters.interleaved(streams, order))), 1e-11
        )
    with pytest.raises(ValueError, match="stream 1 comes 2 times in the order, but its value and inputs have 3"):
        filters.compile_filter(kf).filter_streams(beliefs(2), streams, order[:4])
    with pytest.raises(ValueError, match="names streams 0 to 2, but 2"):
        filters.interleaved(streams, order + 1 - (order == 0).long())


@pytest.mark.slow
def test_events_that_fail_are_named_as_elsewhere():
    ukf = filters.UnscentedKalmanFilter()
    sequence = [Event(None, SPEED, tensor(0.1)), Event(None, SPEED, tensor(torch.inf))]
    with pytest.raises(filters.FilterError, match=r"step 1 of 2.*measured value"):
        filters.compile_filter(ukf).filter_events(beliefs(2), sequence)


@pytest.mark.slow
def test_the_vehicle_of_the_examples(tmp_path):
    """Late fixes are worth no less than those in time, once they are there; headers are torch to 1e-12."""
    example = load_example("fuse_vehicle")
    streams, order, truth = example.simulate(400)
    sequence = filters.interleaved(streams, order)
    compiled = filters.compile_filter(example.FILTER).filter_streams(example.start(), streams, order)
    eager = example.FILTER.filter_events(example.start(), sequence)
    assert_same_track(compiled, eager)
    refused = compiled.count[order == 0] == 0
    assert 0 < int(refused.sum()) < 0.15 * len(refused)
    assert example.rms(compiled.filtered.mean - truth) < 1.0
    assert_same_belief(example.late(sequence)[-1], compiled.filtered[-1], 1e-12)
    assert max(example.export(tmp_path).values()) < 1e-12
    assert sorted(file.name for file in tmp_path.iterdir()) == ["compass.hpp", "gps.hpp", "wheel.hpp"]


class Directions:
    """Unit vectors; a tangent is what is added before the length is made one again, in the plane of two rows."""

    point_size, tangent_size = 3, 2

    def retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        moved = point + (tangent.unsqueeze(-2) @ self._rows(point)).squeeze(-2)
        return torch.nn.functional.normalize(moved, dim=-1)

    def local(self, point: Tensor, other: Tensor) -> Tensor:
        ahead = (point * other).sum(dim=-1, keepdim=True)
        return (self._rows(point) @ other.unsqueeze(-1)).squeeze(-1) / ahead

    def _rows(self, point: Tensor) -> Tensor:
        x, y, z = point.unbind(-1)
        flat, share = torch.zeros_like(x), 1.0 / (1.0 + z)
        return torch.stack(
            [torch.stack([1.0 - x * x * share, -x * y * share, flat - x], -1),
             torch.stack([-x * y * share, 1.0 - y * y * share, flat - y], -1)], -2
        )  # fmt: skip


@pytest.mark.slow
def test_an_extended_filter_on_a_manifold_of_ones_own_is_compiled(caplog: pytest.LogCaptureFixture):
    space, count = Directions(), 2
    motion = filters.MotionModel(lambda at, step: space.retract(at, step), filters.Diagonal(tensor(1e-4, 1e-4)))
    see = filters.MeasurementModel(lambda at: at[..., :2], filters.Diagonal(tensor(0.01, 0.01)))
    ekf, start = filters.ExtendedKalmanFilter(space), tensor(0.0, 0.0, 1.0).expand(count, 3)
    prior = filters.Gaussian(start, (0.1 * EYE).expand(count, 2, 2))
    values, steps = 0.2 * random_numbers(6, count, 2, seed=1), 0.1 * random_numbers(5, count, 2, seed=2)
    with caplog.at_level(logging.INFO):
        found = filters.compile_filter(ekf, motion, see)(prior, values, [steps])
    assert_same_track(found, ekf.filter(prior, motion, see, values, [steps]))
    assert "no arithmetic" not in caplog.text


@pytest.mark.slow
def test_noise_is_learned_by_gradients_through_the_compiled_filter():
    example = load_example("learn_noise")
    values, fast = example.simulate(300, seed=1), filters.compile_filter(example.FILTER).filter_events
    found = example.learn(values, fast, steps=200)
    # At the maximum the derivative by the logarithms vanishes, uncompiled as well.
    slope, _ = example.gradient(found.log(), values, example.FILTER.filter_events)
    assert float(slope.abs().max()) < 1.0
    assert 0.8 < float(found[1] / example.TRUTH[1]) < 1.25
    assert 0.3 < float(found[0] / example.TRUTH[0]) < 3.0


@pytest.mark.slow
def test_systems_with_noisy_controls_are_compiled_by_events():
    ukf = filters.UnscentedKalmanFilter(iterations=1)
    drive = systems.differential_drive(filters.Diagonal(tensor(0.05, 0.02) ** 2))
    see = systems.range_and_bearing(filters.Diagonal(tensor(0.1, 0.02) ** 2))
    sequence = [
        Event(drive, see, tensor(3.0, 0.4), (tensor(0.5, 0.1), tensor(0.1 + 0.1 * k)), tensor(3.0, 1.0 + k))
        for k in range(4)
    ]
    prior = beliefs(3, scale=0.05)
    found = filters.compile_filter(ukf).filter_events(prior, sequence)
    assert_same_track(found, ukf.filter_events(prior, sequence))

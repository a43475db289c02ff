"""Sequences of events: several sensors and rates, fixed lags, and measurements that come late."""

import pytest
import torch

import sigmaslam_filters as filters
from sigmaslam_filters import Event
from tests.support.filter_assertions import assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

PRIOR = beliefs(2, 2)
EYE = torch.eye(2, dtype=torch.float64)
FAST = filters.LinearMotion(EYE + 0.1 * random_numbers(2, 2), covariances(2, seed=3, scale=0.1))
SLOW = filters.LinearMotion(EYE - 0.2 * random_numbers(2, 2, seed=1), covariances(2, seed=4, scale=0.4))
WIDE = filters.LinearMeasurement(random_numbers(3, 2, seed=5), covariances(3, seed=6))
NARROW = filters.LinearMeasurement(random_numbers(1, 2, seed=7), covariances(1, seed=8))
EVENTS = [
    Event(FAST),
    Event(None, WIDE, random_numbers(2, 3, seed=9)),
    Event(SLOW, NARROW, random_numbers(2, 1, seed=10)),
    Event(None, NARROW, random_numbers(2, 1, seed=11)),
    Event(FAST),
    Event(SLOW, WIDE, random_numbers(2, 3, seed=12)),
]


def joint_beliefs(events: list[Event], element: int, steps: int) -> list[filters.Gaussian]:
    """The states after each event given the first measurements, by conditioning of one large Gaussian."""
    size = len(events)
    maps, noises = [], []
    for event in events:
        moved = event.motion
        assert moved is None or isinstance(moved, filters.LinearMotion)
        maps.append(EYE if moved is None else moved.matrix)
        noises.append(torch.zeros_like(EYE) if moved is None else moved.noise)
    mean = [maps[0] @ PRIOR.mean[element]]
    P = torch.zeros(size, size, 2, 2, dtype=torch.float64)
    P[0, 0] = maps[0] @ PRIOR.covariance[element] @ maps[0].mT + noises[0]
    for k in range(1, size):
        mean.append(maps[k] @ mean[-1])
        for j in range(k):
            P[k, j] = maps[k] @ P[k - 1, j]
            P[j, k] = P[k, j].mT
        P[k, k] = maps[k] @ P[k - 1, k - 1] @ maps[k].mT + noises[k]
    m, C = torch.cat(mean), P.permute(0, 2, 1, 3).reshape(2 * size, 2 * size)
    for k, event in enumerate(events[:steps]):
        if event.measurement is None:
            continue
        assert isinstance(event.measurement, filters.LinearMeasurement)
        assert event.value is not None
        H = torch.zeros(event.value.shape[-1], 2 * size, dtype=torch.float64)
        H[:, 2 * k : 2 * k + 2] = event.measurement.matrix
        gain = C @ H.mT @ torch.linalg.inv(H @ C @ H.mT + event.measurement.noise)
        m, C = m + gain @ (event.value[element] - H @ m), C - gain @ H @ C
    return [filters.Gaussian(m[2 * k : 2 * k + 2], C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]) for k in range(size)]


@pytest.mark.parametrize(
    "bayes", [filters.KalmanFilter(), filters.KalmanFilter(form="qr"), filters.UnscentedKalmanFilter()]
)
def test_events_of_several_sensors_are_filtered_and_smoothed_as_one_large_gaussian(bayes):
    track = bayes.filter_events(PRIOR, EVENTS)
    smoothed, lagged = bayes.smooth(track), bayes.smooth(track, lag=2)
    for element in range(2):
        everything = joint_beliefs(EVENTS, element, len(EVENTS))
        for k in range(len(EVENTS)):
            assert_same_belief(track.filtered[k, element], joint_beliefs(EVENTS, element, k + 1)[k], 1e-11)
            assert_same_belief(smoothed[k, element], everything[k], 1e-11)
            assert_same_belief(lagged[k, element], joint_beliefs(EVENTS, element, k + 3)[k], 1e-11)
    assert track.count.tolist() == [[0, 0], [3, 3], [1, 1], [1, 1], [0, 0], [3, 3]]
    assert track.innovation.shape == (6, 2, 3)
    assert float(track.log_likelihood[0].abs().sum()) == 0.0


def test_lags_reach_from_the_filter_to_the_smoother():
    bayes = filters.UnscentedKalmanFilter()
    track = bayes.filter(beliefs(3, 2), bent_motion(2), bent_measurement(2, 2), random_numbers(5, 3, 2))
    assert_same_belief(bayes.smooth(track, lag=0), track.filtered, 1e-15)
    assert_same_belief(bayes.smooth(track, lag=3)[1:], bayes.smooth(track)[1:], 1e-15)
    assert_same_belief(bayes.smooth(track, lag=4), bayes.smooth(track), 1e-15)
    with pytest.raises(ValueError, match="lag is -1 steps"):
        bayes.smooth(track, lag=-1)


def test_events_without_motion_are_updates_at_one_time_on_a_manifold():
    """The state of both is the same, so are their smoothed beliefs."""
    space = filters.SE2()
    ukf = filters.UnscentedKalmanFilter(space)
    drive = filters.MotionModel(lambda x, u: space.retract(x, u), filters.Diagonal(tensor(0.01, 0.01, 0.01)))
    see = filters.MeasurementModel(lambda x: x[..., :2], filters.Diagonal(tensor(0.1, 0.1)))
    prior = filters.Gaussian(tensor(0.0, 0.0, 3.0), 0.2 * torch.eye(3, dtype=torch.float64))
    step = tensor(0.5, 0.0, 0.3)
    events = [
        Event(drive, see, tensor(0.2, 0.1), [step]),
        Event(None, see, tensor(-0.4, 0.1)),
        Event(drive, see, tensor(-1.0, 0.0), [step]),
    ]
    smoothed = ukf.smooth(ukf.filter_events(prior, events))
    assert_same_belief(smoothed[0], smoothed[1], 1e-12)
    assert float(torch.linalg.eigvalsh(smoothed.covariance).min()) > 0


def test_a_late_measurement_put_in_its_place_is_as_if_it_had_come_in_time():
    late, bayes = 2, filters.KalmanFilter()
    without = [event if k != late else Event(event.motion) for k, event in enumerate(EVENTS)]
    track = bayes.filter_events(PRIOR, without)
    again = bayes.filter_events(track.filtered[late - 1], EVENTS[late:])
    assert_same_belief(again.filtered[-1], bayes.filter_events(PRIOR, EVENTS).filtered[-1], 1e-13)


def test_events_pass_their_options_on():
    wrong = 50.0 + random_numbers(2, 1)
    track = filters.KalmanFilter().filter_events(PRIOR, [Event(FAST), Event(None, NARROW, wrong, robust="student_t")])
    expected = filters.KalmanFilter().update(track.filtered[0], NARROW, wrong, robust="student_t")
    assert_same_belief(track.filtered[1], expected.belief, 1e-15)


def test_a_prior_without_batch_meets_values_with_one():
    events = [Event(FAST), *EVENTS[1:]]
    alone = filters.KalmanFilter().filter_events(PRIOR[0], events)
    expanded = filters.KalmanFilter().filter_events(PRIOR[0].expand((2,)), events)
    assert_same_belief(alone.filtered, expanded.filtered, 1e-15)


def test_events_that_are_not_whole_are_refused():
    with pytest.raises(ValueError, match="needs a value"):
        Event(FAST, WIDE)
    with pytest.raises(ValueError, match="one event at least"):
        filters.KalmanFilter().filter_events(PRIOR, [])

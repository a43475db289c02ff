"""Whole sequences: the Nile, the smoother against the batch solution, manual loops, missing data."""

from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_close, assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

# Annual flow at Aswan, 1871-1970, 1e8 m^3 (Cobb 1978).
NILE = tensor(
    *[1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180, 799, 958, 1140],
    *[1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701, 916, 692, 1020, 1050, 969],
    *[831, 726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862, 698, 845, 744, 796, 1040, 759],
    *[781, 865, 845, 944, 984, 897, 822, 1010, 771, 676, 649, 846, 812, 742, 801, 1040, 860, 874, 848, 890],
    *[744, 749, 838, 1050, 918, 986, 797, 923, 975, 815, 1020, 906, 901, 1170, 912, 746, 919, 718, 714, 740],
)[:, None]
LEVEL = filters.LinearMotion(tensor(1.0)[None], tensor(1469.1)[None])
FLOW = filters.LinearMeasurement(tensor(1.0)[None], tensor(15099.0)[None])


@pytest.mark.parametrize("form", ["auto", "low-rank", "qr"])
def test_nile_has_the_published_values(form):
    bayes = filters.KalmanFilter(form=form)
    track = bayes.filter(filters.Gaussian(tensor(0.0), tensor(1e7)[None]), LEVEL, FLOW, NILE)
    smoothed = bayes.smooth(track)
    found = [
        track.log_likelihood.sum(),
        track.filtered.mean[-1, 0],
        track.filtered.covariance[-1, 0, 0],
        smoothed.mean[0, 0],
        smoothed.covariance[0, 0, 0],
    ]
    expected = tensor(-641.5855784594, 798.3702926, 4032.1579418, 1111.2202576, 4030.5327673)
    torch.testing.assert_close(torch.stack(found), expected, rtol=1e-10, atol=0)


SIZE, MEASUREMENTS, STEPS = 4, 2, 12
A = torch.eye(SIZE, dtype=torch.float64) + 0.2 * random_numbers(SIZE, SIZE)
B2 = random_numbers(SIZE, 2, seed=1)
H = random_numbers(MEASUREMENTS, SIZE, seed=2)
Q, R = covariances(2, seed=3, scale=0.3), covariances(MEASUREMENTS, seed=4)
PRIOR = beliefs(3, SIZE, seed=5)
VALUES = random_numbers(STEPS, 3, MEASUREMENTS, seed=6)
VALUES[4, 1] = torch.nan
VALUES[7, 2, 0] = torch.nan
LINEAR = filters.LinearMotion(A, Q, noise_matrix=B2)
SEEN = filters.LinearMeasurement(H, R)


@cache
def linear_track(form: str = "auto") -> filters.Track:
    return filters.KalmanFilter(form=form).filter(PRIOR, LINEAR, SEEN, VALUES)


def batch_solution(element: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (T, n) and covariances (T, n, n) given all measurements, by the normal equations of x0 and all noises."""
    a, b, h = A.numpy(), B2.numpy(), H.numpy()
    root = np.linalg.cholesky(PRIOR.covariance[element].numpy())
    noise = b @ np.linalg.cholesky(Q.numpy())
    unknowns = SIZE + 2 * (STEPS - 1)
    states = np.zeros((STEPS, SIZE, unknowns))  # state k = offset + states[k] @ unknowns, unknowns standard normal
    offset = np.zeros((STEPS, SIZE))
    states[0, :, :SIZE], offset[0] = root, PRIOR.mean[element].numpy()
    for k in range(1, STEPS):
        states[k], offset[k] = a @ states[k - 1], a @ offset[k - 1]
        states[k, :, SIZE + 2 * (k - 1) : SIZE + 2 * k] = noise
    information, right = np.eye(unknowns), np.zeros(unknowns)
    for k in range(STEPS):
        z = VALUES[k, element].numpy()
        seen = ~np.isnan(z)
        if not seen.any():
            continue
        J, weight = h[seen] @ states[k], np.linalg.inv(R.numpy()[np.ix_(seen, seen)])
        information += J.T @ weight @ J
        right += J.T @ weight @ (z[seen] - h[seen] @ offset[k])
    covariance = np.linalg.inv(information)
    return offset + states @ (covariance @ right), states @ covariance @ states.transpose(0, 2, 1)


@pytest.mark.parametrize(
    "bayes",
    [
        filters.KalmanFilter(),
        filters.KalmanFilter(form="qr"),
        filters.UnscentedKalmanFilter(points=filters.julier(1.0)),
        filters.ExtendedKalmanFilter(),
    ],
    ids=["kf", "kf qr", "ukf", "ekf"],
)
def test_smoother_equals_the_batch_solution_of_a_linear_model(bayes):
    motion, measurement = LINEAR, SEEN
    if bayes.transform != filters.KalmanFilter().transform:
        motion = filters.MotionModel(lambda x, w: x @ A.mT + w @ B2.mT, Q, additive=False)
        measurement = filters.MeasurementModel(lambda x: x @ H.mT, R)
    smoothed = bayes.smooth(bayes.filter(PRIOR, motion, measurement, VALUES))
    for element in range(3):
        mean, covariance = batch_solution(element)
        expected = filters.Gaussian(torch.as_tensor(mean), torch.as_tensor(covariance))
        assert_same_belief(smoothed[:, element], expected, 1e-10)


def test_covariance_only_shrinks_from_predicted_to_filtered_to_smoothed():
    track = linear_track()
    smoothed = filters.KalmanFilter().smooth(track)
    for less, more in ((track.filtered, track.predicted), (smoothed, track.filtered)):
        smallest = torch.linalg.eigvalsh(more.covariance - less.covariance).amin()
        assert float(smallest) > -1e-12
    assert_same_belief(smoothed[-1], track.filtered[-1], 1e-14)


@pytest.mark.parametrize("form", ["auto", "qr"])
def test_sequence_equals_a_loop(form):
    bayes = filters.UnscentedKalmanFilter(form=form)
    u, s = random_numbers(STEPS - 1, 3, SIZE, seed=8), random_numbers(STEPS, 3, 1, seed=9)
    still, seen = bent_motion(SIZE), bent_measurement(SIZE, MEASUREMENTS)
    motion = filters.MotionModel(lambda x, u: still.function(x) + torch.sin(x * u), still.noise)
    measurement = filters.MeasurementModel(lambda x, s: seen.function(x) * (1 + 0.1 * s), seen.noise)
    track = bayes.filter(PRIOR, motion, measurement, VALUES, [u], [s])
    belief = PRIOR
    for k in range(STEPS):
        healthy = torch.ones(3, dtype=torch.bool)
        if k > 0:
            predicted = bayes.predict(belief, motion, u[k - 1])
            belief, healthy = predicted.belief, predicted.healthy
        assert_same_belief(track.predicted[k], belief, 1e-13)
        update = bayes.update(belief, measurement, VALUES[k], s[k])
        belief = update.belief
        assert_same_belief(track.filtered[k], belief, 1e-13)
        for name in ("innovation", "nis", "log_likelihood"):
            assert_close(getattr(track, name)[k], getattr(update, name), 1e-13)
        assert torch.equal(track.healthy[k], update.healthy & healthy)
        assert bool((track.count[k] == update.count).all())


def test_batch_of_sequences_equals_single_sequences():
    track = linear_track()
    smoothed = filters.KalmanFilter().smooth(track)
    for element in range(3):
        alone = filters.KalmanFilter().filter(PRIOR[element], LINEAR, SEEN, VALUES[:, element])
        assert_same_belief(track.filtered[:, element], alone.filtered, 1e-12)
        assert_same_belief(smoothed[:, element], filters.KalmanFilter().smooth(alone), 1e-12)


def test_smoother_in_square_roots_equals_the_one_in_covariances():
    bayes, by_root = filters.UnscentedKalmanFilter(), filters.UnscentedKalmanFilter(form="qr")
    motion, measurement = bent_motion(SIZE), bent_measurement(SIZE, MEASUREMENTS)
    first = bayes.smooth(bayes.filter(PRIOR, motion, measurement, VALUES))
    second = by_root.smooth(by_root.filter(PRIOR, motion, measurement, VALUES))
    assert second.is_square_root
    assert not first.is_square_root
    assert_same_belief(second, first, 1e-11)


def test_smoother_is_positive_semidefinite_in_float32():
    """Precise measurements of a vague state; covariances subtracted from each other would lose the sign."""
    motion = filters.LinearMotion(A.float(), 1e-6 * torch.eye(SIZE))
    measurement = filters.LinearMeasurement(H.float(), 1e-8 * torch.eye(MEASUREMENTS))
    prior = filters.Gaussian(torch.zeros(3, SIZE), 1e4 * torch.eye(SIZE))
    truth = 10 * random_numbers(3, SIZE)
    values = torch.stack([torch.linalg.matrix_power(A, k) @ truth.mT for k in range(20)]).mT @ H.mT
    bayes = filters.KalmanFilter()
    smoothed = bayes.smooth(bayes.filter(prior, motion, measurement, values.float()))
    assert bool(smoothed.mean.isfinite().all())
    assert smoothed.is_square_root
    double = [m.double() for m in (motion.matrix, motion.noise, measurement.matrix, measurement.noise)]
    exact = bayes.smooth(
        bayes.filter(
            prior.to(torch.float64), filters.LinearMotion(*double[:2]), filters.LinearMeasurement(*double[2:]), values
        )
    )
    sigma = exact.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    found = smoothed.to(torch.float64).covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    torch.testing.assert_close(found, sigma, rtol=0.05, atol=0)


def test_wrong_lengths_are_named():
    bayes, motion = (
        filters.KalmanFilter(),
        filters.LinearMotion(A, covariances(SIZE), torch.eye(SIZE, dtype=torch.float64)),
    )
    with pytest.raises(ValueError, match=r"12 measurements need motion inputs of length 11, got 12"):
        bayes.filter(PRIOR, motion, SEEN, VALUES, [random_numbers(12, 3, SIZE)])
    measurement = filters.MeasurementModel(lambda x, s: x[..., :2] * s, R)
    with pytest.raises(ValueError, match=r"12 measurements need measurement inputs of length 12, got 11"):
        filters.UnscentedKalmanFilter().filter(PRIOR, LINEAR, measurement, VALUES, (), [random_numbers(11, 3, 1)])
    with pytest.raises(ValueError, match=r"values \(T, \.\.\., m\) with T > 0 expected, got \(0, 3, 2\)"):
        bayes.filter(PRIOR, LINEAR, SEEN, VALUES[:0])
    with pytest.raises(ValueError, match=r"got \(2,\)"):
        bayes.filter(PRIOR, LINEAR, SEEN, VALUES[0, 0])


def test_one_measurement_is_a_sequence():
    track = filters.KalmanFilter().filter(PRIOR, LINEAR, SEEN, VALUES[:1])
    assert_same_belief(filters.KalmanFilter().smooth(track), track.filtered, 0.0)
    assert_same_belief(track.predicted[0], PRIOR, 0.0)


def drive(bayes: filters.BayesFilter, runs: int, steps: int) -> tuple[filters.Track, Tensor]:
    """Planar poses that odometry moves and positions correct; and the true poses (steps, runs, 3)."""
    space = filters.SE2()
    prior = filters.Gaussian(torch.zeros(runs, 3, dtype=torch.float64), torch.diag(tensor(0.04, 0.04, 0.04)))
    sigma = tensor(0.02, 0.01, 0.03)
    step = tensor(0.5, 0.0, 0.25)
    motion = filters.MotionModel(lambda x: space.retract(x, step.to(x)), filters.Diagonal(sigma.square()))
    measurement = filters.MeasurementModel(lambda x: x[..., :2], filters.Diagonal(tensor(0.04, 0.04)))
    pose = space.retract(prior.mean, 0.2 * random_numbers(runs, 3))
    poses = [pose]
    for k in range(1, steps):
        pose = space.retract(space.retract(pose, step), sigma * random_numbers(runs, 3, seed=10 + k))
        poses.append(pose)
    truth = torch.stack(poses)
    z = truth[..., :2] + 0.2 * random_numbers(steps, runs, 2, seed=99)
    return bayes.filter(prior, motion, measurement, z), truth


@pytest.mark.parametrize("kind", [filters.UnscentedKalmanFilter, filters.ExtendedKalmanFilter])
def test_smoother_on_a_manifold_is_consistent_and_better(kind):
    runs, bayes, space = 300, kind(filters.SE2()), filters.SE2()
    track, truth = drive(bayes, runs, 15)
    smoothed = bayes.smooth(track)

    def nees(belief: filters.Gaussian) -> Tensor:
        error = space.local(belief.mean, truth)
        return (error * torch.linalg.solve(belief.covariance, error)).sum(dim=-1)

    # The mean of 300 chi-squared of 3 is within 3 +- 0.37 in 99 % of all cases; four sigma are allowed for 15 steps.
    for belief in (track.filtered, smoothed):
        assert bool(((nees(belief).mean(dim=1) - 3).abs() < 4 * (6 / runs) ** 0.5).all())
    errors = [space.local(b.mean, truth)[:-1].square().mean() for b in (track.filtered, smoothed)]
    assert float(errors[1]) < 0.8 * float(errors[0])

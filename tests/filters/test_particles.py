"""The particle filter against the Kalman filter, on a manifold, and where no Gaussian does."""

import dataclasses

import pytest
import torch

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import beliefs, covariances, random_numbers, tensor

NUMBER = 40000


@pytest.mark.long
@pytest.mark.parametrize("make", [filters.ParticleFilter, filters.EnsembleKalmanFilter])
def test_particles_of_a_linear_model_converge_to_the_kalman_filter(make):
    motion = filters.LinearMotion(torch.eye(2, dtype=torch.float64) * 0.9, covariances(2, seed=2, scale=0.3))
    see = filters.LinearMeasurement(random_numbers(2, 2, seed=3), covariances(2, seed=4))
    bayes, cloud = filters.KalmanFilter(), make(torch.Generator().manual_seed(0))
    belief = beliefs(3, 2)
    particles = cloud.sample(belief, NUMBER)
    values = random_numbers(4, 3, 2, seed=5)
    values[2, 1, 0] = torch.nan
    for value in values:
        belief, particles = bayes.predict(belief, motion).belief, cloud.predict(particles, motion)
        update = bayes.update(belief, see, value)
        belief = update.belief
        particles, likelihood = cloud.update(particles, see, value)
        found = cloud.gaussian(particles)
        # Five standard errors at an effective number of a tenth.
        error = 5.0 / (0.1 * NUMBER) ** 0.5
        scale = belief.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        assert_close(found.mean / scale, belief.mean / scale, error)
        relative = scale.unsqueeze(-1) * scale.unsqueeze(-2)
        assert_close(found.covariance / relative, belief.covariance / relative, 2.0 * error)
        assert_close(likelihood, update.log_likelihood, error)


def test_noise_that_is_not_additive_goes_through_the_function():
    motion = filters.MotionModel(lambda x, w: x + 2.0 * w, torch.eye(1, dtype=torch.float64), additive=False)
    cloud = filters.ParticleFilter(torch.Generator().manual_seed(1))
    moved = cloud.predict(cloud.sample(filters.Gaussian(tensor(1.0), tensor(1.0)[None]), NUMBER), motion)
    assert_close(cloud.gaussian(moved).covariance, tensor(5.0)[None], 0.04)
    see = filters.MeasurementModel(lambda x, v: x + v, torch.eye(1, dtype=torch.float64), additive=False)
    with pytest.raises(ValueError, match="declare it additive"):
        cloud.update(moved, see, tensor(0.0))


def test_moments_on_a_manifold_are_those_of_the_belief():
    """A heading across the cut."""
    space = filters.SE2()
    cloud = filters.ParticleFilter(torch.Generator().manual_seed(2), space)
    belief = filters.Gaussian(tensor(1.0, 2.0, 3.1), covariances(3, scale=0.1))
    found = cloud.gaussian(cloud.sample(belief, NUMBER))
    assert_close(space.local(belief.mean, found.mean), tensor(0.0, 0.0, 0.0), 0.02)
    assert_close(found.covariance, belief.covariance, 0.01)


def test_two_peaks_stay_two():
    """A position of which only the square is measured: half of the particles stay on each side."""
    cloud = filters.ParticleFilter(torch.Generator().manual_seed(3))
    particles = cloud.sample(filters.Gaussian(tensor(0.0), tensor(4.0)[None]), NUMBER)
    see = filters.MeasurementModel(lambda x: x.square(), filters.Diagonal(tensor(0.1)))
    particles, _ = cloud.update(particles, see, tensor(4.0))
    right = torch.exp(particles.log_weights)[particles.states[:, 0] > 0].sum()
    assert 0.45 < float(right) < 0.55
    assert_close(cloud.gaussian(particles).covariance, tensor(4.0)[None], 0.1)
    assert float(particles.effective_number) > 0.5 * NUMBER


def test_an_ensemble_follows_forty_states_that_particles_lose():
    """A hundred samples of forty random walks, each measured."""
    unit = filters.Diagonal(torch.ones(40, dtype=torch.float64))
    walk, see = filters.MotionModel(lambda x: x, unit), filters.MeasurementModel(lambda x: x, unit)
    generator, errors = torch.Generator().manual_seed(5), []
    for make in (filters.EnsembleKalmanFilter, filters.ParticleFilter):
        cloud, truth = make(torch.Generator().manual_seed(4)), torch.zeros(40, dtype=torch.float64)
        belief = filters.Gaussian(truth, torch.eye(40, dtype=torch.float64))
        particles, squares = cloud.sample(belief, 100), []
        for _ in range(20):
            draws = torch.randn(2, 40, generator=generator, dtype=torch.float64)
            truth, particles = truth + draws[0], cloud.predict(particles, walk)
            particles, _ = cloud.update(particles, see, truth + draws[1])
            squares.append((cloud.gaussian(particles).mean - truth).square().mean())
        errors.append(float(torch.stack(squares).mean().sqrt()))
    assert errors[0] < 1.0 < 1.5 * errors[0] < errors[1]  # 1 is the error of the measurement


def test_an_ensemble_s_heading_crosses_the_cut():
    space, noise = filters.SE2(), filters.Diagonal(tensor(0.01, 0.01, 0.01))
    see = filters.MeasurementModel(lambda x: x, noise, residual=lambda measured, seen: space.local(seen, measured))
    cloud = filters.EnsembleKalmanFilter(torch.Generator().manual_seed(6), space)
    belief = filters.Gaussian(tensor(1.0, 2.0, 3.1), 0.01 * torch.eye(3, dtype=torch.float64))
    value = tensor(1.1, 2.0, -3.1)
    found = cloud.gaussian(cloud.update(cloud.sample(belief, NUMBER), see, value)[0])
    expected = filters.UnscentedKalmanFilter(space).update(belief, see, value).belief
    assert_close(space.local(expected.mean, found.mean), tensor(0.0, 0.0, 0.0), 0.02)


@pytest.mark.long
def test_rao_blackwellised_particles_sample_a_part_and_filter_the_rest():
    """One shift of three walks is sampled, the walks are filtered; together they are a linear model."""
    generator, eye, number = torch.Generator().manual_seed(0), torch.eye(4, dtype=torch.float64), 300
    A, Q, H = 0.9 * eye, 0.3 * covariances(4, seed=2), torch.cat([torch.ones_like(eye[:3, :1]), eye[:3, :3]], dim=-1)
    Q[0, 1:] = Q[1:, 0] = 0.0
    motion, see = filters.LinearMotion(A, Q), filters.LinearMeasurement(H, 0.1 * eye[:3, :3])
    shift, walks = filters.LinearMotion(A[:1, :1], Q[:1, :1]), filters.LinearMotion(A[1:, 1:], Q[1:, 1:])
    alone = filters.LinearMeasurement(eye[:3, :3], see.noise)
    bayes, cloud = filters.KalmanFilter(), filters.ParticleFilter(generator)
    belief = filters.Gaussian(torch.zeros(20, 4, dtype=torch.float64), eye)
    plain, particles = cloud.sample(belief, number), cloud.sample(belief.marginal([0]), number)
    particles = dataclasses.replace(particles, beliefs=belief.marginal([1, 2, 3]).expand((number, 20)))
    errors = torch.zeros(2, 2)
    for value in random_numbers(15, 20, 3, seed=5):
        update = bayes.update(bayes.predict(belief, motion).belief, see, value)
        plain, by_samples = cloud.update(cloud.predict(plain, motion), see, value)
        particles = cloud.predict(particles, shift)
        moved = bayes.predict(particles.beliefs, walks).belief
        seen = bayes.update(moved, alone, value - particles.states)
        particles, likelihood = cloud.weigh(dataclasses.replace(particles, beliefs=seen.belief), seen.log_likelihood)
        belief = update.belief
        first = (particles.log_weights.exp().unsqueeze(-1) * particles.beliefs.mean).sum(dim=0)
        mean = torch.cat([cloud.gaussian(particles).mean, first], dim=-1)
        for k, (found, said) in enumerate(((mean, likelihood), (cloud.gaussian(plain).mean, by_samples))):
            errors[k, 0] += (found - belief.mean).square().mean()
            errors[k, 1] += (said - update.log_likelihood).square().mean()
    assert bool((errors[0] < 0.25 * errors[1]).all())
    assert float(errors[0, 0]) / 15 < 0.1**2


@pytest.mark.parametrize("make", [filters.ParticleFilter, filters.EnsembleKalmanFilter])
@pytest.mark.parametrize(("value", "variance"), [([0.1, 0.3], 0.04), ([torch.inf], 0.04), ([0.1], -0.04)])
def test_measurements_that_cannot_be_are_refused(make, value, variance):
    see = filters.LinearMeasurement(tensor(1.0, 0.0)[None], filters.Diagonal(tensor(variance)))
    cloud = make(torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="a measurement is finite, and has as many components as variances"):
        cloud.update(cloud.sample(beliefs(1, 2), 100), see, tensor(*value))

"""Noise that is learned: by expectation maximisation, and by the likelihood's derivatives."""

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import covariances, random_numbers, tensor

EYE = torch.eye(2, dtype=torch.float64)
A = 0.9 * EYE + 0.1 * random_numbers(2, 2)
H = EYE + 0.3 * random_numbers(2, 2, seed=1)
Q, R = covariances(2, seed=2), covariances(2, seed=3)
PRIOR = filters.Gaussian(tensor(0.0, 0.0), EYE)


def sequences(steps: int, batch: int) -> Tensor:
    """(T, B, 2) values of the model."""
    state = random_numbers(batch, 2, seed=4)
    moves = random_numbers(steps, batch, 2, seed=5) @ torch.linalg.cholesky(Q).mT
    noise = random_numbers(steps, batch, 2, seed=6) @ torch.linalg.cholesky(R).mT
    values = []
    for k in range(steps):
        values.append(state @ H.mT + noise[k])
        state = state @ A.mT + moves[k]
    return torch.stack(values)


@pytest.mark.long
def test_expectation_maximisation_finds_the_noise_and_never_loses_likelihood():
    values = sequences(60, 100)
    values[7, 3] = torch.nan
    found = filters.fit_noise(
        PRIOR, filters.LinearMotion(A, 0.2 * EYE), filters.LinearMeasurement(H, 5.0 * EYE), values, 25
    )
    likelihood = found.log_likelihood
    assert bool((likelihood.diff() > -1e-9 * likelihood.abs().max()).all())
    assert_close(found.motion.noise, Q, 0.15)
    assert_close(found.measurement.noise, R, 0.15)
    best = filters.KalmanFilter().filter(PRIOR, found.motion, found.measurement, values).log_likelihood.sum()
    true = filters.KalmanFilter().filter(PRIOR, filters.LinearMotion(A, Q), filters.LinearMeasurement(H, R), values)
    assert float(best) > float(true.log_likelihood.sum()) - 5.0


@pytest.mark.long
def test_a_step_of_expectation_maximisation_ascends_as_the_gradient_does():
    """At the noise that EM stays at, the likelihood's derivatives vanish."""
    values = sequences(30, 20)
    found = filters.fit_noise(PRIOR, filters.LinearMotion(A, Q), filters.LinearMeasurement(H, R), values, 150)

    def likelihood(process: Tensor, noise: Tensor) -> Tensor:
        track = filters.KalmanFilter().filter(
            PRIOR, filters.LinearMotion(A, process), filters.LinearMeasurement(H, noise), values
        )
        return track.log_likelihood.sum()

    learned = found.motion.noise, found.measurement.noise
    at_start = torch.autograd.functional.jacobian(likelihood, (Q, R))
    at_end = torch.autograd.functional.jacobian(likelihood, learned)
    for first, last in zip(at_start, at_end, strict=True):
        assert float(last.abs().max()) < 0.05 * float(first.abs().max())


@pytest.mark.long
def test_noise_of_a_pendulum_s_shadow_with_parts_missing_is_where_the_likelihood_is_largest():
    """Nonlinear models, inputs by time, a residual, and components that are missing one by one."""
    generator, seconds = torch.Generator().manual_seed(0), tensor(0.1, 0.2)[torch.arange(39) % 2].unsqueeze(-1)

    def swing(state: Tensor, dt: Tensor) -> Tensor:
        angle, rate = state.unbind(-1)
        return filters.stack([angle + dt[..., 0] * rate, rate - dt[..., 0] * torch.sin(angle)])

    def differ(measured: Tensor, predicted: Tensor) -> Tensor:
        difference = measured - predicted
        return filters.stack([filters.wrap_angle(difference[..., 0]), difference[..., 1]])

    process, noise = torch.diag(tensor(0.1, 0.2)), tensor(0.05, 0.03, 0.03, 0.1).view(2, 2)
    model = filters.MotionModel(swing, process)
    see = filters.MeasurementModel(lambda x: x + 0.2 * torch.sin(x), noise, residual=differ)
    state, values = random_numbers(60, 2), []
    for k in range(40):
        draws = torch.randn(2, 60, 2, generator=generator, dtype=torch.float64)
        values.append(differ(see.function(state), draws[0] @ torch.linalg.cholesky(noise).mT))
        state = model.function(state, seconds[min(k, 38)]) + draws[1] @ process.sqrt()
    given = torch.stack(values)
    given[torch.rand(given.shape, generator=generator, dtype=torch.float64) < 0.2] = torch.nan
    far = filters.MotionModel(swing, 0.3 * EYE), filters.MeasurementModel(see.function, 0.3 * EYE, residual=differ)
    found = filters.fit_noise(PRIOR, *far, given, 5, seconds)
    assert float(found.log_likelihood.diff().min()) > 10.0
    stays = filters.fit_noise(PRIOR, model, see, given, 4, seconds)
    assert_close(stays.motion.noise, process, 0.02)
    assert_close(stays.measurement.noise, noise, 0.02)
    rise = stays.log_likelihood[-1] - stays.log_likelihood[0]
    assert 0.0 < float(rise) < 0.1 * float(stays.log_likelihood[0] - found.log_likelihood[-1])


def test_derivatives_of_the_likelihood_forward_and_backward_agree():
    values = sequences(4, 2)

    def likelihood(logarithm: Tensor) -> Tensor:
        motion = filters.LinearMotion(A, filters.Diagonal(torch.exp(logarithm[:2])))
        see = filters.LinearMeasurement(H, filters.Diagonal(torch.exp(logarithm[2:])))
        return filters.KalmanFilter().filter(PRIOR, motion, see, values).log_likelihood.sum()

    at = tensor(0.1, -0.2, 0.3, 0.0)
    assert_close(torch.func.jacfwd(likelihood)(at), torch.func.jacrev(likelihood)(at), 1e-11)


def test_filters_can_be_mapped_over_parameters():
    """vmap over noises, as a loop; where nothing can be looked at, nothing can be raised."""
    values, ukf = sequences(3, 2), filters.UnscentedKalmanFilter(on_failure="hold")

    def likelihood(process: Tensor, noise: Tensor) -> Tensor:
        motion = filters.MotionModel(lambda x: torch.sin(x), filters.Diagonal(process))
        see = filters.MeasurementModel(lambda x: x + 0.1 * x.square(), filters.Diagonal(noise))
        return ukf.filter(PRIOR, motion, see, values, robust="student_t").log_likelihood.sum()

    process, noise = random_numbers(3, 2).exp(), random_numbers(3, 2, seed=1).exp()
    expected = torch.stack([likelihood(q, r) for q, r in zip(process, noise, strict=True)])
    assert_close(torch.func.vmap(likelihood)(process, noise), expected, 1e-11)


def test_sequences_that_cannot_be_fitted_are_refused():
    values, motion, see = sequences(5, 1), filters.LinearMotion(A, Q), filters.LinearMeasurement(H, R)
    with pytest.raises(TypeError, match="fit_noise is for states in R"):
        filters.fit_noise(PRIOR, motion, see, values, bayes=filters.UnscentedKalmanFilter(filters.SE2()))
    with pytest.raises(ValueError, match="without noise_matrix"):
        filters.fit_noise(PRIOR, filters.LinearMotion(A, Q, noise_matrix=EYE), see, values)
    for given, steps in ((values[:1], 2), (torch.full_like(values, torch.nan), 2), (values, 0)):
        with pytest.raises(ValueError, match="noise is fitted to two measurements or more"):
            filters.fit_noise(PRIOR, motion, see, given, steps)

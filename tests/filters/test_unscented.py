from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from sigmaslam.filters.linalg import cholesky
from sigmaslam.filters.unscented import WhitenedUpdate, covariance_of, iterated_update, odd_and_even, sigma_offsets

Function = Callable[[Tensor], Tensor]


def random_numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def correlated_covariance(size: int, seed: int = 0) -> Tensor:
    root = random_numbers(size, size, seed=seed)
    return root @ root.T + 0.05 * torch.eye(size, dtype=torch.float64)


def whiteners(noise: Tensor) -> Tensor:
    """Inverse Cholesky factors of noise covariances (m, c, c)."""
    return torch.linalg.inv(torch.linalg.cholesky(noise))


def update(
    function: Function, mean: Tensor, covariance: Tensor, z: Tensor, whitener: Tensor, iterations: int = 1
) -> tuple[Tensor, Tensor, WhitenedUpdate]:
    """Posterior in the coordinates of the state itself; function (k, n) -> (k, m, c)."""
    factor = cholesky(covariance)

    def residual(zeta: Tensor) -> Tensor:
        return (whitener @ (z - function(mean + zeta @ factor.T)).unsqueeze(-1)).flatten(1)

    result = iterated_update(residual, len(mean), iterations, mean)
    return mean + factor @ result.mean, factor @ result.covariance @ factor.T, result


def dense_update(
    function: Function, mean: Tensor, covariance: Tensor, z: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The textbook's update with the cubature set, innovation covariance formed; also NIS and log-likelihood."""
    n = len(mean)
    root = (n**0.5) * torch.linalg.cholesky(covariance)
    points = torch.cat([mean + root.T, mean - root.T])
    values = function(points).flatten(1)
    centre = values.mean(dim=0)
    S = (values - centre).T @ (values - centre) / (2 * n) + torch.block_diag(*noise)
    gain = (points - mean).T @ (values - centre) / (2 * n) @ torch.linalg.inv(S)
    innovation = z.flatten() - centre
    nis = innovation @ torch.linalg.solve(S, innovation)
    log_likelihood = torch.distributions.MultivariateNormal(centre, S).log_prob(z.flatten())
    return mean + gain @ innovation, covariance - gain @ S @ gain.T, nis, log_likelihood


def bearings(landmarks: Tensor) -> Function:
    """Bearing and log range from (x, y, heading) to each landmark, (k, 3) -> (k, m, 2); smooth, not linear."""

    def function(state: Tensor) -> Tensor:
        offset = landmarks - state[:, None, :2]
        angle = torch.atan2(offset[..., 1], offset[..., 0]) - state[:, None, 2]
        return torch.stack([angle, offset.norm(dim=-1).log()], dim=-1)

    return function


LANDMARKS = torch.tensor([[8.0, 1.0], [6.0, -4.0], [9.0, 5.0], [4.0, 3.0], [7.0, -1.0]], dtype=torch.float64)
STATE = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
STATE_COVARIANCE = torch.tensor([[0.3, 0.1, 0.02], [0.1, 0.2, -0.03], [0.02, -0.03, 0.05]], dtype=torch.float64)
NOISE = torch.tensor([[1e-3, 3e-4], [3e-4, 2e-3]], dtype=torch.float64).expand(5, 2, 2)


def seen_from(state: Tensor) -> Tensor:
    return bearings(LANDMARKS)(state[None])[0]


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_filter_equals_kalman_filter_on_a_linear_model(iterations):
    """Correlated prior, partly observed state, several steps: R1's test one."""
    n, m = 6, 2
    transition = torch.eye(n, dtype=torch.float64) + 0.1 * random_numbers(n, n, seed=1)
    process = 0.1 * correlated_covariance(n, seed=2)
    H = torch.cat([random_numbers(m * 2, 3, seed=3), torch.zeros(m * 2, 3, dtype=torch.float64)], dim=1)
    noise = torch.stack([correlated_covariance(2, seed=4), correlated_covariance(2, seed=5)])
    R = torch.block_diag(*noise)
    mean, covariance = random_numbers(n, seed=6), correlated_covariance(n, seed=7)
    exact_mean, exact_covariance = mean, covariance
    for step in range(5):
        points = mean + sigma_offsets(cholesky(covariance))
        mean, spread = covariance_of(points @ transition.T)
        covariance = spread + process
        exact_mean = transition @ exact_mean
        exact_covariance = transition @ exact_covariance @ transition.T + process

        z = random_numbers(m, 2, seed=10 + step)
        mean, covariance, result = update(
            lambda x: (x @ H.T).unflatten(1, (m, 2)), mean, covariance, z, whiteners(noise), iterations
        )
        S = H @ exact_covariance @ H.T + R
        gain = exact_covariance @ H.T @ torch.linalg.inv(S)
        innovation = z.flatten() - H @ exact_mean
        exact_mean = exact_mean + gain @ innovation
        exact_covariance = exact_covariance - gain @ S @ gain.T
        torch.testing.assert_close(mean, exact_mean, rtol=0, atol=1e-10)
        torch.testing.assert_close(covariance, exact_covariance, rtol=0, atol=1e-10)
        torch.testing.assert_close(result.nis, innovation @ torch.linalg.solve(S, innovation), rtol=1e-10, atol=1e-10)


def test_low_rank_update_equals_dense():
    z = seen_from(STATE + torch.tensor([0.2, -0.3, 0.1])) + 0.03 * random_numbers(5, 2)
    found = update(bearings(LANDMARKS), STATE, STATE_COVARIANCE, z, whiteners(NOISE))
    mean, covariance, nis, log_likelihood = dense_update(bearings(LANDMARKS), STATE, STATE_COVARIANCE, z, NOISE)
    torch.testing.assert_close(found[0], mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(found[1], covariance, rtol=0, atol=1e-10)
    torch.testing.assert_close(found[2].nis, nis, rtol=1e-10, atol=0)
    # Whitening leaves the noise's own normalisation to the caller.
    of_the_noise = -0.5 * (torch.logdet(NOISE).sum() + z.numel() * np.log(2 * np.pi))
    torch.testing.assert_close(found[2].log_likelihood + of_the_noise, log_likelihood, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("iterations", [1, 2])
def test_order_of_the_points_does_not_matter(iterations):
    z = seen_from(STATE) + 0.03 * random_numbers(5, 2)
    order = torch.tensor([3, 0, 4, 1, 2])
    noise = torch.stack([(i + 1) * NOISE[0] for i in range(5)])
    first = update(bearings(LANDMARKS), STATE, STATE_COVARIANCE, z, whiteners(noise), iterations)
    second = update(bearings(LANDMARKS[order]), STATE, STATE_COVARIANCE, z[order], whiteners(noise[order]), iterations)
    for a, b in zip((*first[:2], first[2].nis), (*second[:2], second[2].nis), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("iterations", [1, 2])
def test_zero_rows_of_the_whitener_leave_the_measurement_out(iterations):
    z = seen_from(STATE) + 0.03 * random_numbers(5, 2)
    whitener = whiteners(NOISE).clone()
    whitener[[1, 4]] = 0.0
    masked = update(bearings(LANDMARKS), STATE, STATE_COVARIANCE, z, whitener, iterations)
    kept = torch.tensor([0, 2, 3])
    without = update(bearings(LANDMARKS[kept]), STATE, STATE_COVARIANCE, z[kept], whiteners(NOISE[kept]), iterations)
    for a, b in zip((*masked[:2], masked[2].nis), (*without[:2], without[2].nis), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12)


def test_no_measurement_changes_nothing():
    z = torch.zeros(5, 2, dtype=torch.float64)
    whitener = torch.zeros(5, 2, 2, dtype=torch.float64)
    mean, covariance, result = update(bearings(LANDMARKS), STATE, STATE_COVARIANCE, z, whitener, 2)
    torch.testing.assert_close(mean, STATE, rtol=0, atol=1e-15)
    torch.testing.assert_close(covariance, STATE_COVARIANCE, rtol=0, atol=1e-15)
    assert result.nis == 0


def test_a_state_that_is_known_stays_known():
    covariance = STATE_COVARIANCE.clone()
    covariance[2], covariance[:, 2] = 0.0, 0.0
    z = seen_from(STATE) + 0.3
    mean, posterior, _ = update(bearings(LANDMARKS), STATE, covariance, z, whiteners(NOISE), 2)
    assert mean[2] == STATE[2]
    assert (posterior[2] == 0).all()
    assert not torch.equal(mean[:2], STATE[:2])


def test_later_iterations_make_precise_measurements_consistent():
    """R10: many precise points from a vague prior; the first linearisation is at the wrong place."""
    generator = torch.Generator().manual_seed(3)
    landmarks = 6.0 * torch.rand(100, 2, generator=generator, dtype=torch.float64) + tensor(3.0, -3.0)
    sigma = tensor(0.3, 0.3, 0.1)
    noise = 2e-3**2 * torch.eye(2, dtype=torch.float64).expand(100, 2, 2)
    runs = 80
    nees: dict[int, list[float]] = {1: [], 3: []}
    for run in range(runs):
        truth = sigma * random_numbers(3, seed=100 + run)
        z = bearings(landmarks)(truth[None])[0] + 2e-3 * random_numbers(100, 2, seed=500 + run)
        for iterations, values in nees.items():
            mean, posterior, _ = update(
                bearings(landmarks), 0 * sigma, torch.diag(sigma**2), z, whiteners(noise), iterations
            )
            values.append(float((truth - mean) @ torch.linalg.solve(posterior, truth - mean)))
    assert np.mean(nees[1]) > 30.0
    low, high = chi2.ppf([0.005, 0.995], 3 * runs) / runs
    assert low < np.mean(nees[3]) < high


def test_odd_and_even_columns_give_the_sample_covariance():
    samples = random_numbers(14, 3, 4)
    mean, odd, even = odd_and_even(samples)
    assert odd.shape == even.shape == (3, 4, 7)
    deviations = samples - samples.mean(dim=0)
    expected = torch.einsum("kma,kmb->mab", deviations, deviations) / 14
    torch.testing.assert_close(mean, samples.mean(dim=0), rtol=0, atol=1e-15)
    torch.testing.assert_close(odd @ odd.mT + even @ even.mT, expected, rtol=0, atol=1e-14)


def test_even_part_of_a_linear_function_is_zero():
    factor = cholesky(correlated_covariance(5))
    matrix = random_numbers(4, 5, seed=1)
    mean, odd, even = odd_and_even(7.0 + sigma_offsets(factor) @ matrix.T)
    torch.testing.assert_close(mean, torch.full((4,), 7.0, dtype=torch.float64), rtol=0, atol=1e-14)
    torch.testing.assert_close(odd, matrix @ factor, rtol=0, atol=1e-14)
    torch.testing.assert_close(even, torch.zeros_like(even), rtol=0, atol=1e-14)


def test_sigma_points_have_the_covariance_of_the_factor():
    covariance = correlated_covariance(5)
    mean, found = covariance_of(sigma_offsets(cholesky(covariance)))
    torch.testing.assert_close(mean, torch.zeros(5).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(found, covariance, rtol=0, atol=1e-13)


def test_polar_to_cartesian_has_the_published_cubature_moments():
    factor = torch.diag(torch.tensor([0.02, np.deg2rad(15.0)], dtype=torch.float64))
    polar = torch.tensor([1.0, np.pi / 2], dtype=torch.float64) + sigma_offsets(factor)
    mean, covariance = covariance_of(polar[:, :1] * torch.stack([polar[:, 1].cos(), polar[:, 1].sin()], dim=1))
    torch.testing.assert_close(mean, torch.tensor([0.0, 0.9661202212], dtype=torch.float64), rtol=0, atol=5e-11)
    expected = torch.tensor([0.0654638787, 0.0015478394], dtype=torch.float64)
    torch.testing.assert_close(covariance.diagonal(), expected, rtol=0, atol=5e-11)

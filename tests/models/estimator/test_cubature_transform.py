import numpy as np
import torch
from torch import Tensor

from sigmaslam_filters.core import plain_factors
from sigmaslam_models.estimator.cubature_transform import covariance_of, odd_and_even, sigma_offsets
from tests.support.filter_builders import random_numbers


def cholesky(matrix: Tensor) -> Tensor:
    return plain_factors.cholesky(matrix)[0]


def correlated_covariance(size: int, seed: int = 0) -> Tensor:
    root = random_numbers(size, size, seed=seed)
    return root @ root.T + 0.05 * torch.eye(size, dtype=torch.float64)


def test_prediction_of_a_linear_model_is_exact_over_several_steps():
    transition = torch.eye(6, dtype=torch.float64) + 0.1 * random_numbers(6, 6, seed=1)
    process = 0.1 * correlated_covariance(6, seed=2)
    mean, covariance = random_numbers(6, seed=6), correlated_covariance(6, seed=7)
    exact_mean, exact_covariance = mean, covariance
    for _ in range(5):
        mean, spread = covariance_of((mean + sigma_offsets(cholesky(covariance))) @ transition.T)
        covariance = spread + process
        exact_mean = transition @ exact_mean
        exact_covariance = transition @ exact_covariance @ transition.T + process
        torch.testing.assert_close(mean, exact_mean, rtol=0, atol=1e-12)
        torch.testing.assert_close(covariance, exact_covariance, rtol=0, atol=1e-12)


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

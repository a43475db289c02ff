"""The match verifier: what its covariances are, and what the three fitted numbers do."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmaslam_models.verifier_network import VERIFIER_COLUMNS, MatchCovariance, MatchVerifier


@pytest.fixture
def verifier() -> MatchVerifier:
    torch.manual_seed(0)
    return MatchVerifier().eval()


def columns(count: int = 40) -> Tensor:
    return torch.randn(count, VERIFIER_COLUMNS, generator=torch.Generator().manual_seed(1))


def axes(count: int = 40) -> Tensor:
    """Rotations."""
    angle = 2.0 * math.pi * torch.rand(count, generator=torch.Generator().manual_seed(2))
    rows = [torch.stack([angle.cos(), -angle.sin()], dim=1), torch.stack([angle.sin(), angle.cos()], dim=1)]
    return torch.stack(rows, dim=1)


def verified(verifier: MatchVerifier, inputs: Tensor | None = None) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        return verifier(columns() if inputs is None else inputs)


def judged(verifier: MatchVerifier) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        return MatchCovariance(verifier)(columns(), axes())


# Covariance


def test_covariances_are_symmetric_and_positive_definite(verifier):
    _, covariance = judged(verifier)
    assert covariance.shape == (40, 2, 2)
    torch.testing.assert_close(covariance, covariance.mT)
    assert torch.linalg.eigvalsh(covariance.double()).min() > 0


def test_their_eigenvectors_are_the_axes_and_their_eigenvalues_the_variances(verifier):
    _, covariance = judged(verifier)
    _, log_sigma = verified(verifier)
    for k in (0, 1):
        axis = axes()[:, :, k : k + 1]
        torch.testing.assert_close(covariance @ axis, torch.exp(2.0 * log_sigma[:, k, None, None]) * axis)
    assert (log_sigma[:, 0] - log_sigma[:, 1]).abs().min() > 1e-4


def test_axes_that_point_the_other_way_have_the_same_covariance(verifier):
    with torch.no_grad():
        _, turned = MatchCovariance(verifier)(columns(), -axes())
    torch.testing.assert_close(turned, judged(verifier)[1])


def test_probabilities_are_those_of_the_logits(verifier):
    probability, _ = judged(verifier)
    logit, _ = verified(verifier)
    assert probability.shape == (40,)
    assert probability.min() > 0
    assert probability.max() < 1
    torch.testing.assert_close(torch.log(probability) - torch.log1p(-probability), logit)


# Sigma


def test_without_what_it_learned_sigma_is_that_of_an_aligned_patch(verifier):
    """Root of the variance of the difference over the squared gradient, of 1 - correlation and sharpness."""
    for parameter in verifier.layers[-1].parameters():
        torch.nn.init.zeros_(parameter)
    inputs = columns()
    _, log_sigma = verified(verifier, inputs)
    expected = torch.sqrt(torch.exp(inputs[:, 1:2]) / torch.exp(inputs[:, 4:6]))
    torch.testing.assert_close(torch.exp(log_sigma), expected)


@pytest.mark.parametrize(("sign", "bound"), [(-1.0, -4.0), (1.0, 2.5)])
def test_sigma_is_bounded(verifier, sign: float, bound: float):
    inputs = columns()
    inputs[:, 1] = sign * 1000.0
    torch.testing.assert_close(verified(verifier, inputs)[1], torch.full((40, 2), bound))


@pytest.mark.parametrize("factor", [0.5, 1.7])
def test_sigma_scale_scales_sigma_alone(verifier, factor: float):
    probability, covariance = judged(verifier)
    verifier.sigma_scale.fill_(factor)
    scaled_probability, scaled = judged(verifier)
    torch.testing.assert_close(scaled, factor**2 * covariance)
    torch.testing.assert_close(scaled_probability, probability)


# Probability


@pytest.mark.parametrize(("scale", "shift"), [(0.4, 0.0), (1.0, -1.5), (2.0, 0.7)])
def test_scale_and_shift_act_on_the_logit_alone(verifier, scale: float, shift: float):
    logit, log_sigma = verified(verifier)
    verifier.logit_scale.fill_(scale)
    verifier.logit_shift.fill_(shift)
    fitted, same = verified(verifier)
    torch.testing.assert_close(fitted, scale * logit + shift)
    torch.testing.assert_close(same, log_sigma)


def test_columns_are_standardised_by_their_mean_and_spread(verifier):
    """Theory alone takes them as they are: that is the same in both."""
    mean, spread = torch.linspace(-1.0, 1.0, VERIFIER_COLUMNS), torch.linspace(0.5, 2.0, VERIFIER_COLUMNS)
    inputs = columns()
    plain, _ = verified(verifier, (inputs - mean) / spread)
    verifier.mean.copy_(mean)
    verifier.spread.copy_(spread)
    torch.testing.assert_close(verified(verifier, inputs)[0], plain, rtol=1e-4, atol=1e-5)


def test_matches_are_judged_one_by_one(verifier):
    logit, log_sigma = verified(verifier)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(verified(verifier, columns()[order])[0], logit[order])
    torch.testing.assert_close(verified(verifier, columns()[:1])[1], log_sigma[:1])


def test_what_was_fitted_is_saved_with_the_weights(verifier):
    verifier.sigma_scale.fill_(1.3)
    verifier.logit_scale.fill_(0.6)
    verifier.logit_shift.fill_(-0.2)
    verifier.mean.copy_(torch.arange(float(VERIFIER_COLUMNS)))
    other = MatchVerifier().eval()
    other.load_state_dict(verifier.state_dict())
    for a, b in zip(judged(other), judged(verifier), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())

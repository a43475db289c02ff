"""What a repeated sighting tells, and noise that is learned."""

import numpy as np
import pytest
import torch

from sigmaslam_localisation.sighting_noise import CORRELATION_SECONDS, learned_scale, repetition


@pytest.mark.long
def test_repetitions_tell_together_what_a_markov_process_tells():
    """The variance of the best mean of correlated errors, by their full covariance."""
    for spacing in (0.2, 1.0, 10.0):
        count = int(400 * CORRELATION_SECONDS / spacing)
        rho = np.exp(-spacing / CORRELATION_SECONDS)
        column = rho ** np.arange(min(count, 3000))
        count = len(column)
        covariance = column[np.abs(np.subtract.outer(np.arange(count), np.arange(count)))]
        information = np.linalg.solve(covariance, np.ones(count)).sum()
        growth = float(repetition(torch.tensor([spacing], dtype=torch.float64)))
        assert abs(count / growth / information - 1) < 2 * growth / count + 0.01


def test_a_first_sighting_is_not_inflated():
    assert repetition(torch.tensor([torch.inf])).tolist() == [1.0]
    assert torch.isfinite(repetition(torch.zeros(1))).all()


@pytest.mark.long
def test_the_scale_finds_the_variance_of_each_component():
    generator = torch.Generator().manual_seed(3)
    scale, true = torch.ones(1, 2, dtype=torch.float64), torch.tensor([4.0, 0.04], dtype=torch.float64)
    nominal, predicted = torch.tensor([0.5, 0.1]).double(), torch.tensor([0.3, 0.02]).double()
    history = []
    for _ in range(4000):
        deviation = torch.sqrt(predicted + true * nominal)
        innovation = deviation * torch.randn(1, 3, 2, generator=generator, dtype=torch.float64)
        expected = (nominal * scale)[:, None].expand(1, 3, 2)
        share, present = torch.ones(1, 3).double(), torch.tensor([[True, True, False]])
        scale = learned_scale(scale, innovation, predicted.expand(1, 3, 2), expected, share, present)
        history.append(scale[0])
    # The second component hides below the belief's part: its scale is small, and known less well.
    found = torch.stack(history[2000:]).mean(dim=0)
    assert abs(float(found[0]) / 4.0 - 1) < 0.1
    assert float(found[1]) < 0.4


def test_nothing_is_learned_from_nothing():
    scale = torch.ones(2, 2)
    value = torch.full((2, 3, 2), 9.0)
    ones, nothing = torch.ones(2, 3, 2), torch.zeros(2, 3, dtype=bool)
    assert torch.equal(learned_scale(scale, value, ones, ones, torch.ones(2, 3), nothing), scale)

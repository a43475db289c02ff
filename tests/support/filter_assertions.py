"""Comparisons that the tests of the filters share."""

from __future__ import annotations

import torch
from torch import Tensor

from sigmaslam_filters import Gaussian, Update


def assert_close(actual: Tensor, expected: Tensor, tolerance: float) -> None:
    """Relative to the largest expected entry, or absolute where that is below one."""
    assert actual.shape == expected.shape, f"{tuple(actual.shape)}, not {tuple(expected.shape)}"
    scale = max(1.0, float(expected.detach().abs().max())) if expected.numel() else 1.0
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance * scale)


def assert_same_belief(actual: Gaussian, expected: Gaussian, tolerance: float) -> None:
    assert_close(actual.mean, expected.mean, tolerance)
    assert_close(actual.covariance, expected.covariance, tolerance)


def assert_same_update(actual: Update, expected: Update, tolerance: float) -> None:
    """All that an update says, but for the signs that a root is free in."""
    assert_same_belief(actual.belief, expected.belief, tolerance)
    for name in ("innovation", "nis", "log_likelihood", "innovation_covariance", "gain"):
        assert_close(getattr(actual, name), getattr(expected, name), tolerance)
    assert torch.equal(actual.healthy, expected.healthy)

"""compile_step does what the step does, whatever else was compiled."""

import pytest
import torch

import sigmaslam_filters as filters


def make_step(scale: float):
    """A step that differs from its siblings in a constant only."""
    ukf = filters.UnscentedKalmanFilter(iterations=1, on_failure="hold")
    motion = filters.LinearMotion(torch.eye(2), filters.Diagonal(torch.full((2,), 0.01)))
    polar = filters.MeasurementModel(
        lambda x: filters.stack([scale * torch.hypot(x[..., 0], x[..., 1]), torch.atan2(x[..., 1], x[..., 0])]),
        filters.Diagonal(torch.full((2,), 0.1)),
    )

    def step(mean, root, value):
        belief = filters.Gaussian(mean, factor=root, factor_is_lower=True)
        result = ukf.update(ukf.predict(belief, motion).belief, polar, value)
        return result.belief.mean, result.belief.covariance, result.nis, result.healthy

    return step


@pytest.mark.slow
def test_a_filter_with_the_default_settings_compiles_and_raises_as_it_does_uncompiled():
    ukf = filters.UnscentedKalmanFilter()
    see = filters.MeasurementModel(lambda x: x[..., :1] * x[..., :1], filters.Diagonal(torch.full((1,), 0.1)))
    still = filters.MotionModel(lambda x: 1.0 * x, filters.Diagonal(torch.full((2,), 0.01)))

    def step(mean, covariance, value):
        result = ukf.update(ukf.predict(filters.Gaussian(mean, covariance), still).belief, see, value)
        return result.belief.mean, result.belief.covariance, result.healthy

    mean, covariance, value = torch.ones(3, 2), torch.eye(2).repeat(3, 1, 1), 2.0 * torch.ones(3, 1)
    compiled = filters.compile_step(step)
    for a, b in zip(compiled(mean, covariance, value), step(mean, covariance, value), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    covariance[1, 0, 0] = -1.0
    with pytest.raises(filters.FilterError, match=r"predict failed.*\(1,\).*prior covariance.*eigenvalue -1"):
        compiled(mean, covariance, value)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [(), (200,)], ids=["one", "batch"])
def test_steps_of_one_factory_do_not_share_compiled_code(batch):
    generator = torch.Generator().manual_seed(0)
    prior = filters.Gaussian(2 + torch.randn(*batch, 2, generator=generator), 0.1 * torch.eye(2))
    value = 2 + torch.randn(*batch, 2, generator=generator)
    for scale in (1.0, 3.0):
        step = make_step(scale)
        expected = step(prior.mean, prior.factor, value)
        found = filters.compile_step(step)(prior.mean, prior.factor, value)
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_only_plain_functions_are_compiled():
    with pytest.raises(TypeError, match="plain function"):
        filters.compile_step(torch.nn.Linear(2, 2))

"""The tracker's estimator in torch: batches, parts and special cases; what it finds in tests/sigmaslam/estimation."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import vmap

from sigmaslam.estimation.calibration_errors import measured_errors
from sigmaslam.estimation.state_layout import VIEW_TURNS
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_filters.core import plain_factors, unrolled_factors
from sigmaslam_models.estimator.calibration_errors import unmodelled_errors
from sigmaslam_models.estimator.frame_update import FrameViews, RobustStep, update_frame
from sigmaslam_models.estimator.graph_examples import ROBUST_INPUTS, WINDOW_INPUTS, frame_example, window_example
from sigmaslam_models.estimator.residuals import mask_missing
from sigmaslam_models.estimator.window_solution import Condition, EliminateLandmarks, WindowViews
from tests.support.filter_builders import tensor

FREEDOM = tensor(2.0)[0]


def spd(*shape: int, seed: int = 0) -> Tensor:
    """Positive definite matrices of badly scaled unknowns."""
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(*shape, shape[-1], generator=generator, dtype=torch.float64)
    scale = 10.0 ** torch.linspace(-4, 4, shape[-1], dtype=torch.float64)
    return scale[:, None] * (root @ root.mT + torch.eye(shape[-1], dtype=torch.float64)) * scale


@pytest.mark.parametrize("shape", [(1, 1), (7, 3), (2, 3, 9)])
def test_factors_and_inverses_are_those_of_lapack(shape):
    matrix = spd(*shape)
    right = torch.randn(*shape, 5, dtype=torch.float64)
    factor = torch.linalg.cholesky(matrix)
    torch.testing.assert_close(plain_factors.definite_cholesky(matrix), factor, rtol=1e-9, atol=1e-12)
    expected = torch.linalg.solve_triangular(factor, right, upper=False)
    torch.testing.assert_close(unrolled_factors.whiten(right, matrix), expected, rtol=1e-8, atol=1e-9)
    inverse = plain_factors.invert(matrix)
    torch.testing.assert_close(inverse, inverse.mT, rtol=0, atol=0)
    # In units of each unknown's deviation: no digit is lost to the scales.
    sigma = torch.diagonal(torch.cholesky_inverse(factor), dim1=-2, dim2=-1).sqrt()
    difference = (inverse - torch.cholesky_inverse(factor)) / (sigma[..., None] * sigma[..., None, :])
    assert difference.abs().max() < 1e-10


def test_errors_of_a_calibration_are_those_of_the_run_time():
    camera = RectifiedStereo(fx=400.0, fy=410.0, cx=320.0, cy=240.0, baseline=0.2, width=640, height=480)
    uvd = np.random.default_rng(0).uniform((0, 0, -1), (640, 480, 40), (20, 3))
    intrinsics = tensor(400.0, 410.0, 320.0, 240.0, 80.0)
    found = unmodelled_errors(intrinsics, torch.from_numpy(uvd))
    np.testing.assert_allclose(found.numpy(), measured_errors(camera, uvd)[:, :, 3:-VIEW_TURNS], rtol=1e-12, atol=1e-12)


def test_a_missing_disparity_says_nothing():
    measurement = tensor(3.0, 4.0, float("nan"))[None]
    noise = spd(1, 3)
    residual, masked, components = mask_missing(measurement, tensor(1.0, 1.0, 7.0)[None], noise)
    assert residual.tolist() == [[2.0, 3.0, 0.0]]
    assert components.tolist() == [2.0]
    torch.testing.assert_close(masked[:, :2, :2], noise[:, :2, :2])
    assert masked[0, 2].tolist() == [0.0, 0.0, 1e12]


def some_frames(count: int) -> list[tuple[Tensor, ...]]:
    names = ("measurement", "noise", *FrameViews._fields)
    return [frame_example(seed, 3, 30, *names) for seed in range(count)]


def updated(measurement: Tensor, noise: Tensor, *fields: Tensor) -> tuple[Tensor, ...]:
    return update_frame(measurement, noise, FrameViews(*fields), FREEDOM)


def test_a_batch_of_frames_is_the_frames_one_by_one():
    frames = some_frames(4)
    together = vmap(updated)(*(torch.stack(each) for each in zip(*frames, strict=True)))
    for k, frame in enumerate(frames):
        for found, expected in zip(together, updated(*frame), strict=True):
            torch.testing.assert_close(found[k], expected, rtol=1e-8, atol=1e-10)


def test_a_batch_of_windows_is_the_windows_one_by_one():
    windows = [window_example(seed, 3, 12, *WINDOW_INPUTS, *WindowViews._fields) for seed in range(3)]
    together = vmap(EliminateLandmarks())(*(torch.stack(each) for each in zip(*windows, strict=True)))
    for k, window in enumerate(windows):
        for found, expected in zip(together, EliminateLandmarks()(*window), strict=True):
            torch.testing.assert_close(found[k], expected, rtol=1e-8, atol=1e-7)


def test_views_that_measure_nothing_leave_the_prior():
    names = (*ROBUST_INPUTS, *FrameViews._fields)
    inputs = dict(zip(names, frame_example(0, 3, 20, *names), strict=True))
    inputs["noise"] = 1e9 * torch.eye(3, dtype=torch.float64).expand(20, 3, 3)
    inputs["scale"] = torch.tensor(1.0, dtype=torch.float64)
    offset, spread, _, _ = RobustStep()(*inputs.values())
    prior = inputs["factor"] @ inputs["factor"].mT
    torch.testing.assert_close(spread, prior, rtol=1e-3, atol=1e-9)
    assert offset.abs().max() < 1e-3


def test_the_order_of_views_does_not_matter():
    measurement, noise, *fields = some_frames(1)[0]
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    per_view = {"pair", "common", "covariance", "estimate", "dependence"}
    shuffled = [
        value[order] if name in per_view else value for name, value in zip(FrameViews._fields, fields, strict=True)
    ]
    expected = updated(measurement, noise, *fields)
    found = updated(measurement[order], noise[order], *shuffled)
    for one, other in zip(found[:2], expected[:2], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-11)
    assert (found[2] == expected[2][order]).all()


def test_what_is_learned_of_a_singular_prior_is_the_textbook_posterior():
    """Of three numbers the last is a copy of the first, and the second is known."""
    factor = tensor(2.0, 0.0, 2.0)[:, None]
    prior = factor @ factor.mT
    generator = torch.Generator().manual_seed(0)
    root, common = (torch.randn(3, size, generator=generator, dtype=torch.float64) for size in (3, 12))
    information, vector = root @ root.mT, tensor(1.0, -2.0, 3.0)
    gain = torch.linalg.inv(torch.eye(3, dtype=torch.float64) + prior @ information)
    mean, covariance, considered = Condition()(factor, information, vector, common)
    torch.testing.assert_close(covariance, gain @ prior, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(mean, gain @ prior @ vector, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(considered, common - gain @ prior @ information @ common, rtol=1e-9, atol=1e-9)
    assert mean[1] == 0.0
    assert mean[2] == mean[0]

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.features import batch_loss
from sigmaslam_training.features.batch_loss import _zoom, pair_loss
from sigmaslam_training.features.losses import MatchLoss, match_loss, place_loss
from sigmaslam_training.features.stream import NOWHERE


def unit(*shape: int, seed: int = 0) -> Tensor:
    return functional.normalize(torch.randn(*shape, generator=torch.Generator().manual_seed(seed)), dim=-1)


def loss_of(descriptors0: Tensor, descriptors1: Tensor, quality: Tensor, visible: Tensor) -> MatchLoss:
    distractors = unit(*descriptors1.shape, seed=9)
    return match_loss(descriptors0, descriptors1, distractors, quality, visible, torch.ones_like(visible))


EVERYTHING = torch.ones(2, 40, dtype=torch.bool)


def test_perfect_descriptors_have_full_recall_and_little_loss():
    descriptors = unit(2, 40, 64)
    loss = loss_of(descriptors, descriptors, torch.full((2, 40), 8.0), EVERYTHING)
    assert float(loss.recall) == 1.0
    assert float(loss.descriptor) < 0.01
    assert float(loss.quality) < 0.01


def test_unrelated_descriptors_are_no_better_than_chance():
    loss = loss_of(unit(2, 40, 64), unit(2, 40, 64, seed=1), torch.zeros(2, 40), EVERYTHING)
    assert float(loss.recall) < 0.2
    assert float(loss.descriptor) > np.log(40)
    assert float(loss.quality) == pytest.approx(np.log(2), rel=1e-5)


def test_loss_equals_the_definition_written_as_loops():
    d0, d1, extra = unit(1, 6, 8), unit(1, 6, 8, seed=1), unit(1, 3, 8, seed=2)
    visible = torch.tensor([[True, False, True, True, True, False]])
    loss = match_loss(d0, d1, extra, torch.zeros(1, 6), visible, visible, inverse_temperature=5.0)
    terms = []
    for i in range(6):
        if not visible[0, i]:
            continue
        columns = [d1[0, j] for j in range(6) if visible[0, j]] + list(extra[0])
        forward = sum(torch.exp(5 * d0[0, i] @ column) for column in columns)
        backward = sum(torch.exp(5 * d0[0, j] @ d1[0, i]) for j in range(6))
        score = torch.exp(5 * d0[0, i] @ d1[0, i])
        terms.append(-(torch.log(score / forward) + torch.log(score / backward)))
    assert float(loss.descriptor) == pytest.approx(float(sum(terms)) / len(terms), rel=1e-5)


def test_points_that_left_the_image_do_not_matter():
    """What image 1 shows at the place of an invisible point, and what is thought of it, changes nothing."""
    d0, d1 = unit(2, 40, 64), unit(2, 40, 64, seed=1)
    visible = EVERYTHING.clone()
    visible[:, 5:12] = False
    quality = torch.randn(2, 40, generator=torch.Generator().manual_seed(3))
    changed1, changed_quality = d1.clone(), quality.clone()
    changed1[:, 5:12] = unit(2, 7, 64, seed=4)
    changed_quality[:, 5:12] = 50.0
    first, second = loss_of(d0, d1, quality, visible), loss_of(d0, changed1, changed_quality, visible)
    for name in ("descriptor", "quality", "recall"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-6, atol=1e-6)


def test_no_visible_point_gives_zero_and_finite_gradients():
    d0 = unit(2, 40, 64).requires_grad_()
    loss = loss_of(d0, unit(2, 40, 64, seed=1), torch.zeros(2, 40), torch.zeros_like(EVERYTHING))
    (loss.descriptor + loss.quality).backward()
    assert loss.descriptor == loss.quality == loss.recall == 0
    assert torch.isfinite(d0.grad).all()


def test_quality_is_asked_for_where_the_corner_repeats():
    descriptors = unit(1, 10, 64)
    repeated = torch.arange(10)[None] < 5
    visible = torch.ones(1, 10, dtype=torch.bool)
    right = torch.where(repeated, 8.0, -8.0)
    losses = [
        float(match_loss(descriptors, descriptors, unit(1, 3, 64, seed=2), q, visible, repeated).quality)
        for q in (right, -right)
    ]
    assert losses[0] < 0.01
    assert losses[1] > 5


def test_place_loss_is_the_density_of_a_t_law_with_that_standard_deviation():
    """Of a bivariate Student t vector: a normal one over the root of a chi-square of 3 degrees, independently."""
    distance, sigma = torch.tensor([[0.3, 2.0]]), 0.7
    log_sigma = torch.full((1, 2), math.log(sigma))
    everything = torch.ones(1, 2, dtype=torch.bool)
    zoom = torch.tensor([[2.0]])
    loss = place_loss(distance, log_sigma, log_sigma, zoom, everything)
    # Sigma of image 0 grows with the zoom; the law's shape matrix is its covariance over three.
    variance = (2.0**2 + 1.0) * sigma**2
    law = stats.multivariate_t(shape=variance / 3.0 * np.eye(2), df=3)
    expected = [-law.logpdf([float(d), 0.0]) for d in distance[0]]
    constant = -law.logpdf([0.0, 0.0]) - math.log(variance)
    assert float(loss) == pytest.approx(np.mean(expected) - constant, rel=1e-5)


def test_place_loss_is_least_at_the_standard_deviation_and_counts_partners_alone():
    draws = stats.multivariate_t(shape=np.eye(2) / 3.0, df=3, seed=0).rvs(20_000)
    distance = torch.from_numpy(np.linalg.norm(draws, axis=1)[None]).float()
    partnered = torch.ones_like(distance, dtype=torch.bool)
    distance[:, ::2], partnered[:, ::2] = 100.0, False

    def loss(sigma: float) -> float:
        log_sigma = torch.full_like(distance, math.log(sigma / math.sqrt(2.0)))
        return float(place_loss(distance, log_sigma, log_sigma, torch.ones(1, 1), partnered))

    assert loss(1.0) < min(loss(0.9), loss(1.1))


def test_zoom_is_the_scale_of_a_similarity():
    points = 100 * torch.rand(2, 30, 2, generator=torch.Generator().manual_seed(0))
    turn = torch.tensor([[0.8, 0.6], [-0.6, 0.8]])
    visible = torch.rand(2, 30, generator=torch.Generator().manual_seed(1)) < 0.7
    moved = points @ turn * torch.tensor([1.7, 0.6]).view(2, 1, 1) + 20.0
    moved[~visible] = 1e4
    torch.testing.assert_close(_zoom(points, moved, visible), torch.tensor([[1.7], [0.6]]), rtol=1e-4, atol=0)


def test_every_partner_teaches_quality_whether_it_is_a_distractor_or_not():
    """Keypoints of image 1 at the true places, in odd rows alone: the even ones, distractors, are nowhere."""
    torch.manual_seed(0)
    network = FeatureNetwork()
    image = torch.rand(1, 1, 96, 96)
    corners = 10 + 70 * torch.rand(1, 12, 2)
    found = torch.stack([torch.full_like(corners, NOWHERE), corners], dim=2).reshape(1, 24, 2)
    visible = torch.ones(1, 12, dtype=torch.bool)
    asked: dict[str, Tensor] = {}

    def spy(*arguments: Tensor) -> MatchLoss:
        asked["repeated"] = arguments[-1]
        return match_loss(*arguments)

    with pytest.MonkeyPatch.context() as context:
        context.setattr(batch_loss, "match_loss", spy)
        pair_loss(network, image, image, corners, corners, visible, found, torch.Generator().manual_seed(5))
    assert asked["repeated"].all()


def test_step_of_the_same_generator_is_the_same_and_reaches_every_weight():
    torch.manual_seed(0)
    network = FeatureNetwork()
    images = torch.rand(2, 1, 96, 96, generator=torch.Generator().manual_seed(1))
    corners = 10 + 70 * torch.rand(2, 12, 2, generator=torch.Generator().manual_seed(2))
    batch = (images, images, corners, corners, torch.ones(2, 12, dtype=torch.bool), corners)
    losses = [pair_loss(network, *batch, torch.Generator().manual_seed(5)) for _ in range(2)]
    assert losses[0].descriptor == losses[1].descriptor
    (losses[0].descriptor + losses[0].quality + losses[0].place).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name

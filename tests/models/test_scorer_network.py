"""The match scorer: what its logits must not depend on, and what it learns from neighbours alone."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from sigmaslam.frontend.scorer_inputs import nearest_matches
from sigmaslam_evaluation.metrics.probability_calibration import auroc
from sigmaslam_models.scorer_network import SIDE_CHANNELS, MatchScorer, ScoredMatches

pytestmark = pytest.mark.usefixtures("one_thread")
# points0 (B, M, 2), points1 (B, M, 2), side (B, M, 9), near (B, M, K), weight (B, M)
Inputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


@pytest.fixture(scope="module")
def scorer() -> MatchScorer:
    """Of random weights, larger than at the start of a training: all that it is told matters."""
    torch.manual_seed(0)
    scorer = MatchScorer().eval()
    with torch.no_grad():
        for parameter in scorer.parameters():
            parameter.mul_(1.5)
    return scorer


def match_set(count: int, seed: int, wrong: float = 0.3) -> tuple[Inputs, np.ndarray]:
    """A similarity with noise of half a pixel and outliers; side information says nothing. Also what is right."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform(0.0, 384.0, (count, 2))
    angle, zoom = rng.uniform(-np.pi, np.pi), np.exp(rng.uniform(-0.5, 0.5))
    turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points1 = points0 @ turn.T + rng.uniform(-50.0, 50.0, 2) + rng.normal(0.0, 0.5, points0.shape)
    right = rng.random(count) >= wrong
    points1[~right] = rng.permutation(points1)[~right] + rng.uniform(-20.0, 20.0, ((~right).sum(), 2))
    side = rng.uniform(0.0, 1.0, (1, count, SIDE_CHANNELS)).astype(np.float32)
    near = nearest_matches(points0.astype(np.float32), np.ones(count, bool))
    first, second = (torch.from_numpy(points.astype(np.float32))[None] for points in (points0, points1))
    return (first, second, torch.from_numpy(side), torch.from_numpy(near)[None], torch.ones(1, count)), right


def logits_of(scorer: MatchScorer, inputs: Inputs) -> Tensor:
    with torch.no_grad():
        return scorer(*inputs)


def padded(inputs: Inputs, extra: int) -> Inputs:
    """With so many matches that do not count, at places and of side information that would matter."""
    points0, points1, side, near, weight = inputs
    count, generator = near.shape[1], torch.Generator().manual_seed(9)
    own = torch.arange(count, count + extra).view(1, extra, 1).expand(1, extra, near.shape[2])
    places = [300.0 * torch.rand(1, extra, 2, generator=generator) for _ in range(2)]
    return (
        torch.cat([points0, places[0]], dim=1),
        torch.cat([points1, places[1]], dim=1),
        torch.cat([side, torch.rand(1, extra, SIDE_CHANNELS, generator=generator)], dim=1),
        torch.cat([near, own], dim=1),
        torch.cat([weight, torch.zeros(1, extra)], dim=1),
    )


def test_there_is_a_logit_a_match_and_round(scorer):
    for count in (1, 2, 9, 60):
        logits = logits_of(scorer, match_set(count, 0)[0])
        assert logits.shape == (3, 1, count)
        assert torch.isfinite(logits).all()
    assert MatchScorer(rounds=4)(*match_set(9, 0)[0]).shape == (5, 1, 9)


def test_it_is_small():
    assert sum(parameter.numel() for parameter in MatchScorer().parameters()) < 50_000


def test_matches_in_another_order_have_the_same_logits(scorer):
    (points0, points1, side, near, weight), _ = match_set(80, 1)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(0))
    new_index = torch.argsort(order)
    turned = (points0[:, order], points1[:, order], side[:, order], new_index[near[:, order]], weight[:, order])
    logits = logits_of(scorer, (points0, points1, side, near, weight))
    torch.testing.assert_close(logits_of(scorer, turned), logits[:, :, order], rtol=1e-4, atol=1e-4)
    assert logits[-1].std() > 0.01


def test_what_fills_up_a_batch_does_not_matter(scorer):
    inputs, _ = match_set(50, 2)
    logits = logits_of(scorer, inputs)
    torch.testing.assert_close(logits_of(scorer, padded(inputs, 30))[:, :, :50], logits, rtol=1e-4, atol=1e-4)


def test_sets_of_a_batch_do_not_mix(scorer):
    short, long = match_set(50, 3)[0], match_set(80, 4)[0]
    both = tuple(torch.cat(pair) for pair in zip(padded(short, 30), long, strict=True))
    logits = logits_of(scorer, both)
    torch.testing.assert_close(logits[:, :1, :50], logits_of(scorer, short), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(logits[:, 1:], logits_of(scorer, long), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shifts", [((100.0, -60.0), (100.0, -60.0)), ((-200.0, 0.0), (7.0, 150.0))])
def test_where_the_images_lie_does_not_matter(scorer, shifts):
    (points0, points1, *rest), _ = match_set(80, 5)
    moved = logits_of(scorer, (points0 + torch.tensor(shifts[0]), points1 + torch.tensor(shifts[1]), *rest))
    torch.testing.assert_close(moved, logits_of(scorer, (points0, points1, *rest)), rtol=0, atol=2e-3)


def test_a_wrong_place_of_one_match_changes_its_logit(scorer):
    (points0, points1, *rest), _ = match_set(80, 6, wrong=0.0)
    before = logits_of(scorer, (points0, points1, *rest))[-1, 0, 7]
    points1[0, 7] += torch.tensor([30.0, 0.0])
    assert abs(logits_of(scorer, (points0, points1, *rest))[-1, 0, 7] - before) > 1e-3


def test_neighbours_at_one_place_are_finite_and_have_gradients():
    """Several orientations of one keypoint, and a set that is a single place."""
    torch.manual_seed(0)
    scorer = MatchScorer()
    (points0, points1, side, near, weight), _ = match_set(40, 7)
    for first, second in ((points0.clone(), points1), (torch.zeros_like(points0), torch.zeros_like(points1))):
        first[:, ::2] = first[:, 1::2]
        logits = scorer(first, second, side, near, weight)
        scorer.zero_grad()
        logits.square().sum().backward()
        assert torch.isfinite(logits).all()
        assert all(torch.isfinite(p.grad).all() for p in scorer.parameters() if p.grad is not None)


def test_every_parameter_learns():
    torch.manual_seed(0)
    scorer = MatchScorer()
    inputs, right = match_set(80, 8)
    logits = scorer(*inputs)
    target = torch.from_numpy(right).float().expand_as(logits)
    binary_cross_entropy_with_logits(logits, target).backward()
    for name, parameter in scorer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


def test_the_graph_of_one_set_gives_the_logits_of_the_last_round(scorer):
    inputs, _ = match_set(60, 9)
    with torch.no_grad():
        (logits,) = ScoredMatches(scorer)(*(each[0] for each in inputs[:4]))
    torch.testing.assert_close(logits, logits_of(scorer, inputs)[-1, 0])


@pytest.mark.long
def test_matches_that_agree_with_their_neighbours_are_learned_to_be_right():
    """Nothing but the field of the matches tells; in the held-out sets it turns and zooms otherwise."""
    torch.manual_seed(0)
    scorer = MatchScorer()
    optimizer = torch.optim.AdamW(scorer.parameters(), 5e-3)
    for step in range(30):
        sets = [match_set(120, 100 + 4 * step + k) for k in range(4)]
        inputs = (torch.cat(each) for each in zip(*(inputs for inputs, _ in sets), strict=True))
        logits = scorer(*inputs)
        target = torch.from_numpy(np.stack([right for _, right in sets])).float()
        loss = binary_cross_entropy_with_logits(logits, target.expand_as(logits))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(scorer.parameters(), 1.0)
        optimizer.step()
    for seed in range(3):
        inputs, right = match_set(200, seed, wrong=0.4)
        logits = logits_of(scorer.eval(), inputs)[:, 0].numpy()
        assert auroc(logits[-1], right) > 0.95
        # The first logit knows the side information alone, which says nothing here.
        assert abs(auroc(logits[0], right) - 0.5) < 0.15

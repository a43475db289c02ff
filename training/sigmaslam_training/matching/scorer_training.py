"""Trains the match scorer on putative matches of rendered pairs."""

from collections.abc import Callable, Iterator, Sequence
from itertools import count, islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from sigmaslam.frontend.scorer_inputs import NEIGHBOURS, nearest_matches, side_information
from sigmaslam_evaluation.metrics.probability_calibration import RIGHT
from sigmaslam_models.scorer_network import SIDE_CHANNELS, MatchScorer
from sigmaslam_training.matching.match_sets import MatchSet
from sigmaslam_training.small_loop import train_steps

LEARNING_RATE = 3e-3
SETS_A_STEP = 8
_MAX_MATCHES = 512
# Weight of the round before the first, of those in between, and of the last.
_ROUND_WEIGHTS = (0.2, 0.4, 1.0)

# points0 (M, 2), points1 (M, 2), side (M, 9), near (M, K), error (M,) in pixels
Sample = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def make_sample(match_set: MatchSet, rows: np.ndarray | None = None) -> Sample:
    """What the scorer sees of a set as the run time would show it, and the error of each match.

    Args:
        rows: only these of its matches.
    """
    rows = np.arange(len(match_set.places)) if rows is None else rows
    putative = match_set.putative.select(rows)
    points0, points1 = match_set.features0.keypoints[putative.index0], match_set.features1.keypoints[putative.index1]
    side = side_information(putative, match_set.features0, match_set.features1)
    error = np.linalg.norm(points1 - match_set.places[rows], axis=1)
    return points0, points1, side, nearest_matches(points0, putative.mutual), error


def vary_sample(match_set: MatchSet, rng: np.random.Generator) -> Sample:
    """A sample of at most 512 matches, with images turned or mirrored alike, and parts of what is known left out.

    What one kind of features says of itself another does not, or says otherwise: the scorer must not rely on it.
    """
    count = min(len(match_set.places), _MAX_MATCHES)
    if rng.random() < 0.5:
        count = max(24, int(count * rng.uniform(0.3, 1.0)))
    rows = np.sort(rng.choice(len(match_set.places), min(count, len(match_set.places)), replace=False))
    points0, points1, side, near, error = make_sample(match_set, rows)
    if rng.random() < 0.25:
        side[:, 6:8] = 0.5
    if rng.random() < 0.25:
        side[:, 8] = 0.0
    if rng.random() < 0.1:
        side[:, 4:6] = side[:, 4:6] ** rng.uniform(0.3, 3.0)
    if rng.random() < 0.1:
        side[:, [2, 5]] = 0.5, 1.0
    sign = rng.choice([-1.0, 1.0], 2).astype(np.float32)
    points0, points1 = points0 * sign, points1 * sign
    if rng.random() < 0.5:
        points0, points1 = points0[:, ::-1], points1[:, ::-1]
    return points0, points1, side, near, error


def collate(samples: Sequence[Sample]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """One batch: points0, points1, side, near, weight (0 for what fills up) and error (infinite there)."""
    batch, most = len(samples), max(len(sample[0]) for sample in samples)
    points0, points1 = np.zeros((batch, most, 2), np.float32), np.zeros((batch, most, 2), np.float32)
    side = np.zeros((batch, most, SIDE_CHANNELS), np.float32)
    near = np.tile(np.arange(most)[None, :, None], (batch, 1, NEIGHBOURS))
    weight, error = np.zeros((batch, most), np.float32), np.full((batch, most), np.inf, np.float32)
    for row, sample in enumerate(samples):
        count = len(sample[0])
        arrays: tuple[np.ndarray, ...] = points0, points1, side, near, error
        for array, values in zip(arrays, sample, strict=True):
            array[row, :count] = values
        weight[row, :count] = 1.0
    first, second, known, close, counted, off = map(torch.from_numpy, (points0, points1, side, near, weight, error))
    return first, second, known, close, counted, off


def scorer_loss(logits: Tensor, weight: Tensor, error: Tensor) -> Tensor:
    """Cross-entropy of all rounds, every set counting alike.

    Args:
        logits: (R, B, M) as `MatchScorer` gives them.
        weight, error: (B, M) as `collate` gives them.
    """
    right = (error < RIGHT).to(logits.dtype)
    each = binary_cross_entropy_with_logits(logits, right.expand_as(logits), reduction="none") * weight
    by_round = (each.sum(dim=2) / weight.sum(dim=1)).mean(dim=1)
    first, between, last = _ROUND_WEIGHTS
    factors = torch.tensor([first, *[between] * (len(logits) - 2), last], dtype=logits.dtype, device=logits.device)
    return (by_round * factors).sum()


@torch.no_grad()
def score_set(scorer: MatchScorer, match_set: MatchSet) -> np.ndarray:
    """(M,) logits of all matches of a set."""
    scorer.eval()
    return np.asarray(scorer(*collate([make_sample(match_set)])[:5])[-1, 0].numpy())


def train_scorer(
    sets: Sequence[MatchSet], steps: int, seed: int, checkpoint: Path, note: Callable[[int, str], None]
) -> MatchScorer:
    """Trains from random weights, or goes on from the checkpoint.

    Args:
        sets: to learn from.
        steps: of the optimiser, of 8 sets each.
        seed: of weights, order and variation.
        checkpoint: file for the state, every 250 steps and when the run is stopped.
        note: is told of every step and the loss.
    Raises:
        InputError: the checkpoint is of another training.
        KeyboardInterrupt: the run was stopped; it goes on from the checkpoint.
    """
    torch.manual_seed(seed)
    scorer = MatchScorer()
    optimizer = torch.optim.AdamW(scorer.parameters(), LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps, pct_start=0.05)

    def losses(done: int) -> Iterator[Tensor]:
        order = islice(_endless_order(len(sets), seed), done * SETS_A_STEP, None)
        for step in count(done):
            rng = np.random.default_rng((seed, 4, step))
            *inputs, weight, error = collate([vary_sample(sets[next(order)], rng) for _ in range(SETS_A_STEP)])
            yield scorer_loss(scorer(*inputs, weight), weight, error)

    made_of = {"steps": steps, "seed": seed, "sets": len(sets)}
    train_steps(scorer, optimizer, schedule, steps, losses, checkpoint, made_of, note, max_gradient=1.0)
    return scorer


def _endless_order(count: int, seed: int) -> Iterator[int]:
    """All indices in a random order, again and again in another one."""
    lap = 0
    while True:
        yield from np.random.default_rng((seed, 5, lap)).permutation(count).tolist()
        lap += 1

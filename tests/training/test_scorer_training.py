"""The match scorer's batches, loss and training on sets made here."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from sigmaslam.errors import InputError
from sigmaslam.frontend.nearest_neighbours import Putative
from sigmaslam.frontend.scorer_inputs import NEIGHBOURS, nearest_matches
from sigmaslam.frontend.types import Features
from sigmaslam_models.scorer_network import MatchScorer
from sigmaslam_training import small_loop
from sigmaslam_training.matching import scorer_training as scorer_training
from sigmaslam_training.matching.match_sets import MatchSet
from sigmaslam_training.matching.scorer_training import (
    Sample,
    collate,
    make_sample,
    score_set,
    scorer_loss,
    train_scorer,
    vary_sample,
)
from sigmaslam_training.snapshot import read_snapshot

pytestmark = pytest.mark.usefixtures("one_thread")


def match_set(count: int, seed: int = 0) -> MatchSet:
    """Places where the keypoints of image 0 are, as between two views from one place; a third of matches is off.

    Errors are then the lengths of the matches, |points1 - points0|.
    """
    rng = np.random.default_rng(seed)
    keypoints0, order = rng.uniform(10.0, 370.0, (2 * count, 2)), rng.permutation(count)
    keypoints1 = keypoints0[:count] + np.where(rng.random(count) < 0.33, 30.0, 0.5)[:, None] * rng.normal(size=2)
    both = (
        Features(
            keypoints.astype(np.float32),
            np.zeros((len(keypoints), 0), np.float32),
            rng.random(len(keypoints), np.float32),
            rng.uniform(0.5, 2.0, len(keypoints)).astype(np.float32),
        )
        for keypoints in (keypoints0, keypoints1[order])
    )
    index0 = np.arange(count)
    similarity, *others = np.sort(rng.random((3, count), np.float32), axis=0)[::-1]
    putative = Putative(index0, np.argsort(order)[index0], similarity, *others)
    return MatchSet("planes", *both, putative, keypoints0, np.ones(2 * count, bool))


def without_truth(found: MatchSet, rows: slice) -> MatchSet:
    visible = found.visible.copy()
    visible[rows] = False
    return replace(found, visible=visible)


def layout_of(sample: Sample, found: MatchSet) -> tuple[tuple[float, float, bool], np.ndarray]:
    """Signs of (u, v) and whether they are swapped, as was done to image 0; and which matches of the set these are."""
    fitting = []
    rows_of = {tuple(point): row for row, point in enumerate(found.features0.keypoints[found.putative.index0].tolist())}
    for u, v, swapped in itertools.product((-1.0, 1.0), (-1.0, 1.0), (False, True)):
        back = [tuple(point) for point in laid_back(sample[0], (u, v, swapped)).tolist()]
        if all(point in rows_of for point in back):
            fitting.append(((u, v, swapped), np.array([rows_of[point] for point in back])))
    assert len(fitting) == 1
    return fitting[0]


def laid_back(points: np.ndarray, layout: tuple[float, float, bool]) -> np.ndarray:
    """Points (N, 2) as they were before the image was mirrored, then turned."""
    u, v, swapped = layout
    return (points[:, ::-1] if swapped else points) * np.array([u, v], np.float32)


# Samples


def test_a_sample_has_the_points_of_its_matches_and_their_errors():
    found = without_truth(match_set(40), slice(0, 5))
    points0, points1, side, near, error = make_sample(found)
    np.testing.assert_array_equal(points0, found.features0.keypoints[:40])
    assert side.shape == (40, 9)
    assert near.shape == (40, NEIGHBOURS)
    assert np.isinf(error[:5]).all()
    np.testing.assert_allclose(error[5:], np.linalg.norm(points1 - points0, axis=1)[5:], atol=1e-4)


def test_a_part_of_a_set_is_as_if_the_others_had_not_been_found():
    found, rows = match_set(60), np.arange(3, 60, 2)
    sample = make_sample(found, rows)
    alone = replace(found, putative=found.putative.select(rows))
    for a, b in zip(sample, make_sample(alone), strict=True):
        np.testing.assert_array_equal(a, b)


def test_errors_stay_with_their_points_when_images_are_turned_or_mirrored():
    found = match_set(80)
    for seed in range(20):
        points0, points1, _, _, error = vary_sample(found, np.random.default_rng(seed))
        np.testing.assert_allclose(np.linalg.norm(points1 - points0, axis=1), error, atol=1e-3)


def test_a_varied_sample_is_a_part_of_the_set_with_both_images_laid_in_one_of_eight_ways():
    found, layouts, counts = match_set(80), set(), set()
    for seed in range(60):
        sample = vary_sample(found, np.random.default_rng(seed))
        layout, rows = layout_of(sample, found)
        assert len(np.unique(rows)) == len(rows)
        points0, points1, _, near, error = make_sample(found, rows)
        for varied, plain in zip(sample[:2], (points0, points1), strict=True):
            np.testing.assert_array_equal(laid_back(varied, layout), plain)
        np.testing.assert_array_equal(sample[3], near)
        np.testing.assert_array_equal(sample[4], error)
        layouts.add(layout)
        counts.add(len(rows))
    assert len(layouts) == 8
    assert max(counts) == 80
    assert len(counts) > 10


def test_a_varied_sample_depends_on_its_generator_alone_and_leaves_the_set():
    found = match_set(80)
    before = [found.features0.keypoints.copy(), found.putative.similarity.copy(), found.places.copy()]
    first, second = (vary_sample(found, np.random.default_rng(3)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    for array, copy in zip((found.features0.keypoints, found.putative.similarity, found.places), before, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize(("count", "most"), [(10, 10), (30, 30), (700, 512)])
def test_a_varied_sample_is_neither_too_large_nor_emptied(count: int, most: int):
    found = match_set(count)
    counts = [len(vary_sample(found, np.random.default_rng(seed))[0]) for seed in range(20)]
    assert max(counts) == most
    assert min(counts) >= min(count, 24)


def test_what_the_features_say_of_themselves_is_left_out_at_times():
    found = match_set(60)
    sides = [vary_sample(found, np.random.default_rng(seed))[2] for seed in range(60)]
    scores = np.mean([(side[:, 6:8] == 0.5).all() for side in sides])
    sigmas = np.mean([(side[:, 8] == 0.0).all() for side in sides])
    assert 0.05 < scores < 0.5
    assert 0.05 < sigmas < 0.5
    assert all(np.isfinite(side).all() for side in sides)


# Batches


def test_a_batch_holds_its_samples_and_fills_up_what_lacks():
    samples = [make_sample(match_set(count, count)) for count in (20, 35)]
    *arrays, weight, error = collate(samples)
    assert [tuple(array.shape) for array in arrays] == [(2, 35, 2), (2, 35, 2), (2, 35, 9), (2, 35, NEIGHBOURS)]
    for row, sample in enumerate(samples):
        count = len(sample[0])
        for array, values in zip((*arrays, error), sample, strict=True):
            np.testing.assert_allclose(array[row, :count].numpy(), values, rtol=1e-6)
        assert weight[row].tolist() == [1.0] * count + [0.0] * (35 - count)
        assert torch.isinf(error[row, count:]).all()
        own = torch.arange(count, 35)[:, None].expand(-1, NEIGHBOURS)
        assert torch.equal(arrays[3][row, count:], own)
    assert all(array.dtype == torch.float32 for array in (*arrays[:3], weight, error))
    assert arrays[3].dtype == torch.int64


def test_a_set_is_scored_as_in_a_batch():
    torch.manual_seed(0)
    scorer = MatchScorer()
    sets = [match_set(count, count) for count in (25, 60)]
    with torch.no_grad():
        together = scorer(*collate([make_sample(found) for found in sets])[:5])[-1]
    for row, found in enumerate(sets):
        np.testing.assert_allclose(
            score_set(scorer, found), together[row, : len(found.places)].numpy(), rtol=1e-4, atol=1e-4
        )


# Loss


def loss_inputs() -> tuple[Tensor, Tensor, Tensor]:
    """Logits of three rounds of two sets, of 4 and of 7 matches."""
    generator = torch.Generator().manual_seed(0)
    logits = 2.0 * torch.randn(3, 2, 7, generator=generator)
    weight = torch.ones(2, 7)
    weight[0, 4:] = 0.0
    error = 6.0 * torch.rand(2, 7, generator=generator)
    error[0, 4:] = torch.inf
    return logits, weight, error


def test_loss_counts_sets_alike_and_rounds_by_their_weight():
    logits, weight, error = loss_inputs()
    right = (error < 3.0).float()
    expected = sum(
        factor
        * 0.5
        * (
            binary_cross_entropy_with_logits(logits[k, 0, :4], right[0, :4])
            + binary_cross_entropy_with_logits(logits[k, 1], right[1])
        )
        for k, factor in enumerate((0.2, 0.4, 1.0))
    )
    torch.testing.assert_close(scorer_loss(logits, weight, error), torch.as_tensor(expected))


def test_what_fills_up_has_no_part_in_the_loss():
    logits, weight, error = loss_inputs()
    other = logits.clone()
    other[:, 0, 4:] = 50.0
    other.requires_grad_()
    loss = scorer_loss(other, weight, error)
    torch.testing.assert_close(loss, scorer_loss(logits, weight, error))
    loss.backward()
    assert (other.grad[:, 0, 4:] == 0).all()
    assert (other.grad[:, 1] != 0).all()


def test_loss_vanishes_for_what_is_known_and_a_match_3_pixels_off_is_wrong():
    error = torch.tensor([[0.0, 2.99, 3.0, 50.0, torch.inf]])
    logits = torch.tensor([20.0, 20.0, -20.0, -20.0, -20.0]).expand(3, 1, 5)
    assert float(scorer_loss(logits, torch.ones(1, 5), error)) < 1e-6
    assert float(scorer_loss(-logits, torch.ones(1, 5), error)) == pytest.approx(20.0 * 1.6, rel=1e-4)


# Training


@pytest.fixture(scope="module")
def sets() -> list[MatchSet]:
    return [match_set(40, seed) for seed in range(5)]


def train(sets: list[MatchSet], checkpoint: Path, stop_in: int | None = None, seed: int = 0) -> MatchScorer:
    def note(step: int, message: str) -> None:
        if step == stop_in:
            raise KeyboardInterrupt

    return train_scorer(sets, 4, seed, checkpoint, note)


def assert_same_weights(a: MatchScorer, b: MatchScorer) -> None:
    for name, value in a.state_dict().items():
        assert torch.equal(value, b.state_dict()[name]), name


def test_a_run_that_was_stopped_ends_bit_for_bit_as_one_that_was_not(
    sets: list[MatchSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(small_loop, "SAVE_EVERY", 2)
    whole = train(sets, tmp_path / "whole.safetensors")
    stopped = tmp_path / "stopped.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train(sets, stopped, stop_in=3)
    assert read_snapshot(stopped).facts["step"] == 3
    torch.rand(7)
    taken: list[int] = []
    again = train_scorer(sets, 4, 0, stopped, lambda step, _: taken.append(step))
    assert taken == [4]
    assert_same_weights(again, whole)


def test_a_finished_run_is_read_from_its_checkpoint(sets: list[MatchSet], tmp_path: Path):
    whole = train(sets, tmp_path / "scorer.safetensors")
    assert_same_weights(train(sets, tmp_path / "scorer.safetensors", stop_in=1), whole)


def test_a_run_that_is_stopped_keeps_the_steps_it_made(sets: list[MatchSet], tmp_path: Path):
    """As its documentation has it; a checkpoint is due every 250 steps otherwise."""

    with pytest.raises(KeyboardInterrupt):
        train(sets, tmp_path / "scorer.safetensors", stop_in=3)
    assert (tmp_path / "scorer.safetensors").is_file()


def test_a_checkpoint_of_another_training_is_refused(sets: list[MatchSet], tmp_path: Path):
    train(sets, tmp_path / "scorer.safetensors")
    with pytest.raises(InputError, match=r"made with seed 0, not seed 1: resume"):
        train(sets, tmp_path / "scorer.safetensors", seed=1)
    with pytest.raises(InputError, match=r"made with sets 5, not sets 4: resume"):
        train(sets[1:], tmp_path / "scorer.safetensors")


def test_the_same_seed_trains_the_same_weights_and_another_one_others(sets: list[MatchSet], tmp_path: Path):
    first, second, other = (
        train(sets, tmp_path / f"{name}.safetensors", seed=seed) for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert_same_weights(first, second)
    assert not torch.equal(first.trust[1][0].weight, other.trust[1][0].weight)
    assert not first.training


def test_every_set_is_seen_once_a_lap_in_another_order_each():
    order = scorer_training._endless_order(7, 3)
    laps = [[next(order) for _ in range(7)] for _ in range(5)]
    assert all(sorted(lap) == list(range(7)) for lap in laps)
    assert len({tuple(lap) for lap in laps}) > 1


def test_neighbours_of_a_sample_are_those_of_the_run_time():
    found = match_set(60)
    points0, _, _, near, _ = make_sample(found)
    np.testing.assert_array_equal(near, nearest_matches(points0, found.putative.mutual))

"""What the match scorer is told: side information that means the same for every kind of features, and neighbours."""

import numpy as np
import pytest

from sigmaslam.frontend.nearest_neighbours import Putative, nearest_anywhere
from sigmaslam.frontend.scorer_inputs import NEIGHBOURS, nearest_matches, side_information
from sigmaslam.frontend.types import Features

KINDS = (
    "similarity",
    "margin to the runner-up in image 1",
    "margin to the runner-up in image 0",
    "mutual",
    "ratio in image 1",
    "ratio in image 0",
    "score in image 0",
    "score in image 1",
    "log of sigma1 over sigma0",
)


def features(count: int, seed: int) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.standard_normal((count, 16)).astype(np.float32)
    return Features(
        rng.uniform(0.0, 400.0, (count, 2)).astype(np.float32),
        descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True),
        rng.gamma(2.0, 1.0, count).astype(np.float32),
        rng.uniform(0.3, 3.0, count).astype(np.float32),
    )


@pytest.fixture(scope="module")
def matched() -> tuple[Putative, Features, Features]:
    """All nearest neighbours of random descriptors, and their features."""
    features0, features1 = features(150, 0), features(130, 1)
    return nearest_anywhere(features0.descriptors, features1.descriptors), features0, features1


def two_matches() -> tuple[Putative, Features, Features]:
    """The first is mutual and clear, the second neither."""
    putative = Putative(
        index0=np.array([2, 0]),
        index1=np.array([1, 1]),
        similarity=np.array([0.96, 0.84]),
        second0=np.array([0.84, 0.96]),
        second1=np.array([0.36, 0.96]),
    )
    scores0, sigma0 = np.array([9.0, 5.0, 7.0]), np.array([1.0, 1.0, 2.0])
    features0 = Features(np.zeros((3, 2)), np.zeros((3, 0)), scores0, sigma0)
    features1 = Features(np.zeros((2, 2)), np.zeros((2, 0)), np.array([0.2, 0.1]), np.array([1.0, np.e]))
    return putative, features0, features1


def rescored(features: Features, scores: np.ndarray) -> Features:
    return Features(features.keypoints, features.descriptors, scores, features.sigma)


# Side information


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (0, [0.75, 0.25]),
        (1, [0.75, 0.25]),
        (2, [0.75, 0.25]),
        (3, [1.0, 0.0]),
        (4, [0.5, 2.0]),
        (5, [0.25, 2.0]),
        (6, [3 / 6, 5 / 6]),
        (7, [1 / 4, 1 / 4]),
        (8, [1.0 - np.log(2.0), 1.0]),
    ],
    ids=KINDS,
)
def test_two_matches_have_the_values_counted_by_hand(column: int, expected: list[float]):
    np.testing.assert_allclose(side_information(*two_matches())[:, column], expected, atol=2e-3)


def test_side_information_has_a_row_a_match_and_is_float32(matched):
    side = side_information(*matched)
    assert side.shape == (150, 9)
    assert side.dtype == np.float32
    none = matched[0].select(np.zeros(0, np.int64))
    assert side_information(none, *matched[1:]).shape == (0, 9)


@pytest.mark.parametrize("rescale", [np.sqrt, np.log, lambda scores: 255.0 * scores - 7.0], ids=["root", "log", "line"])
def test_scores_of_another_scale_tell_the_same(matched, rescale):
    putative, features0, features1 = matched
    changed = [rescored(each, rescale(each.scores.astype(np.float64))) for each in (features0, features1)]
    np.testing.assert_array_equal(side_information(putative, *changed), side_information(*matched))


def test_ranks_of_similarity_do_not_depend_on_its_scale(matched):
    """Similarities of another kind of descriptors, half as far apart."""
    putative, features0, features1 = matched
    closer = Putative(
        putative.index0,
        putative.index1,
        *(0.5 + 0.5 * each.astype(np.float64) for each in (putative.similarity, putative.second0, putative.second1)),
    )
    side, again = side_information(*matched), side_information(closer, features0, features1)
    np.testing.assert_array_equal(again[:, :4], side[:, :4])
    # Ratios of distances neither, but for what keeps them finite.
    np.testing.assert_allclose(again[:, 4:6], side[:, 4:6], atol=1e-3)


def test_matches_in_another_order_are_told_the_same(matched):
    putative, *both = matched
    order = np.random.default_rng(2).permutation(len(putative.index0))
    np.testing.assert_array_equal(side_information(putative.select(order), *both), side_information(*matched)[order])


def test_matches_of_one_similarity_have_one_rank_in_any_order(matched):
    """Binary descriptors have few distances."""
    putative, *both = matched
    coarse = Putative(
        putative.index0,
        putative.index1,
        *(np.round(8.0 * each) / 8.0 for each in (putative.similarity, putative.second0, putative.second1)),
    )
    side = side_information(coarse, *both)
    for level in np.unique(coarse.similarity):
        assert len(np.unique(side[coarse.similarity == level, 0])) == 1


def test_keypoints_in_another_order_tell_the_same(matched):
    """The ranks of scores are those of the keypoints that the matches are of."""
    putative, features0, features1 = matched
    order = np.random.default_rng(3).permutation(len(features1.scores))
    moved = Putative(
        putative.index0, np.argsort(order)[putative.index1], putative.similarity, putative.second0, putative.second1
    )
    np.testing.assert_array_equal(
        side_information(moved, features0, features1.select(order)), side_information(*matched)
    )


def test_what_is_the_same_everywhere_ranks_in_the_middle(matched):
    putative, features0, features1 = matched
    same = rescored(features0, np.ones(150, np.float32))
    assert (side_information(putative, same, features1)[:, 6] == 0.5).all()


def test_perfect_and_hopeless_matches_stay_within_bounds():
    """Identical descriptors, no runner-up, and sigmas of 0 or beyond measure."""
    ones, index = np.ones(4), np.arange(4)
    sigma0, sigma1 = np.array([0.0, 1.0, 1e9, 1.0]), np.array([1.0, 0.0, 1.0, 1e9])
    both = (Features(np.zeros((4, 2)), np.zeros((4, 0)), ones, sigma) for sigma in (sigma0, sigma1))
    runner_up = np.array([1.0, -1.0, 1.0, -1.0])
    side = side_information(Putative(index, index, ones, runner_up, -ones), *both)
    assert np.isfinite(side).all()
    np.testing.assert_allclose(side[:, 4], [1.0, 0.0, 1.0, 0.0], atol=0.01)
    np.testing.assert_array_equal(side[:, 8], [2.0, -2.0, -2.0, 2.0])


# Neighbours


def brute_force(points: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """The twelve nearest anchors but itself, as a loop."""
    rows = []
    for row, point in enumerate(points):
        others = anchors[anchors != row]
        distance = np.linalg.norm(points[others].astype(np.float64) - point, axis=1)
        rows.append(others[np.argsort(distance)[:NEIGHBOURS]])
    return np.stack(rows)


def points_of(count: int) -> np.ndarray:
    return np.random.default_rng(count).uniform(0.0, 400.0, (count, 2)).astype(np.float32)


@pytest.mark.parametrize("mutuals", [32, 60, 200])
def test_neighbours_are_the_nearest_mutual_matches_but_itself(mutuals: int):
    points = points_of(200)
    mutual = np.random.default_rng(4).permutation(200) < mutuals
    near = nearest_matches(points, mutual)
    assert near.dtype == np.int64
    np.testing.assert_array_equal(near, brute_force(points, np.flatnonzero(mutual)))


@pytest.mark.parametrize("mutuals", [0, 1, 31])
def test_with_few_mutual_matches_all_are_asked(mutuals: int):
    points = points_of(100)
    mutual = np.arange(100) < mutuals
    np.testing.assert_array_equal(nearest_matches(points, mutual), brute_force(points, np.arange(100)))


@pytest.mark.parametrize("count", [0, 1, 2, 5, 12, 13])
def test_a_small_set_is_filled_up_with_the_match_itself(count: int):
    near = nearest_matches(points_of(count), np.ones(count, bool))
    assert near.shape == (count, NEIGHBOURS)
    for row, found in enumerate(near):
        others = found[: count - 1]
        assert sorted(others.tolist()) == [other for other in range(count) if other != row]
        assert (found[count - 1 :] == row).all()


def test_a_match_is_not_its_own_neighbour_among_keypoints_of_one_place():
    """As several orientations at one place are."""
    points = np.repeat(points_of(20), 5, axis=0)
    near = nearest_matches(points, np.ones(100, bool))
    assert (near != np.arange(100)[:, None]).all()
    # The other four of the place come first.
    assert (near[:, :4] // 5 == np.arange(100)[:, None] // 5).all()


def test_matches_in_another_order_have_the_same_neighbours():
    points = points_of(150)
    mutual = np.random.default_rng(5).random(150) < 0.6
    order = np.random.default_rng(6).permutation(150)
    near = nearest_matches(points[order], mutual[order])
    np.testing.assert_array_equal(order[near], nearest_matches(points, mutual)[order])

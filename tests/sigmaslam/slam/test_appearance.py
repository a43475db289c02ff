"""Keyframes ranked by what they look like."""

import numpy as np
import pytest

from sigmaslam.frontend import Features, StereoView
from sigmaslam.slam.appearance import AppearanceIndex, describe


def view_of(descriptors: np.ndarray) -> StereoView:
    """A view of which nothing but its descriptors (N, D) is known."""
    count = len(descriptors)
    flat = np.zeros(count, np.float32)
    features = Features(np.zeros((count, 2), np.float32), descriptors.astype(np.float32), flat, flat)
    return StereoView(np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.uint8), features, flat, flat)


def place(number: int, dimensions: int) -> np.ndarray:
    """(100, D) descriptors of unit length that no other place has."""
    drawn = np.random.default_rng(number).normal(size=(100, dimensions))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def seen_again(number: int, dimensions: int) -> StereoView:
    """Half of a place's descriptors, each a little different, in another order, beside as many of something else."""
    rng = np.random.default_rng(10_000 + number)
    kept = rng.permutation(100)[:50]
    noise = rng.normal(scale=0.3 / np.sqrt(dimensions), size=(50, dimensions))
    return view_of(np.concatenate([place(number, dimensions)[kept] + noise, place(20_000 + number, dimensions)[:50]]))


@pytest.mark.parametrize("dimensions", [64, 128, 256])
def test_a_place_seen_again_is_the_first_of_many(dimensions: int):
    index = AppearanceIndex()
    for number in range(60):
        index.add(number, place(number, dimensions))
    for number in range(0, 60, 12):
        assert index.rank(seen_again(number, dimensions), 1) == [number]


def test_similarity_is_that_of_the_whole_moments():
    """What the vector leaves out, the lower triangle, is counted: two vectors' product is that of (D, D) entries."""
    one, other = place(1, 16), place(2, 16)

    def whole(descriptors: np.ndarray) -> np.ndarray:
        moment = descriptors.T @ descriptors
        root = np.sign(moment) * np.sqrt(np.abs(moment))
        return np.asarray(root / np.linalg.norm(root))

    similarity = describe(one) @ describe(other)
    np.testing.assert_allclose(similarity, (whole(one) * whole(other)).sum(), atol=1e-6)


def test_what_was_removed_is_not_ranked_and_the_others_stay():
    index = AppearanceIndex()
    for number in range(20):
        index.add(number, place(number, 64))
    for number in (3, 19, 0):
        index.remove(number)
    assert len(index) == 17
    assert sorted(index.rank(view_of(place(3, 64)), 100)) == [*range(1, 3), *range(4, 19)]
    assert index.rank(view_of(place(7, 64)), 1) == [7]
    index.add(3, place(3, 64))
    assert index.rank(view_of(place(3, 64)), 1) == [3]


def test_only_those_asked_for_are_ranked():
    index = AppearanceIndex()
    for number in range(10):
        index.add(number, place(number, 64))
    assert sorted(index.rank(view_of(place(2, 64)), 5, among=[1, 4])) == [1, 4]
    assert index.rank(view_of(place(2, 64)), 5, among=[]) == []


def test_without_descriptors_the_newest_come_first():
    index = AppearanceIndex()
    assert index.rank(view_of(np.zeros((5, 0))), 3) == index.rank(view_of(place(0, 64)), 3) == []
    for number in (4, 1, 7):
        index.add(number, np.zeros((5, 0)))
    assert index.rank(view_of(np.zeros((9, 0))), 2) == [7, 4]


def test_order_of_features_does_not_matter():
    descriptors = place(5, 64)
    np.testing.assert_allclose(describe(descriptors), describe(descriptors[::-1]), atol=1e-6)

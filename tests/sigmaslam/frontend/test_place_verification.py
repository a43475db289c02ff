"""Keypoints of the demo followed without features, verified by the shipped network; next to none in noise."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sigmaslam.frontend import Frontend, KeypointSearch, StereoView, TemporalMatches, build_frontend
from sigmaslam.frontend.lucas_kanade import lucas_kanade
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.patch_evidence import examine_patches
from sigmaslam.frontend.types import PatchMaps
from sigmaslam.frontend.verifier_inputs import PlaceSearch
from tests.support.estimates import Demo

# Of predictions, pixels: keypoints are expected where they were.
SIGMA = 8.0


@dataclass(frozen=True, slots=True)
class Carried:
    """A keyframe of the demo and the frame after it.

    Attributes:
        frontend: learned.
        search: for all keypoints with a disparity.
        start: (K, 2) where optical flow takes them.
        view: of the frame after.
        matched: what `match` finds there.
    """

    frontend: Frontend
    search: KeypointSearch
    start: np.ndarray
    view: StereoView
    matched: TemporalMatches

    def follow(self, start: np.ndarray, left: np.ndarray, right: np.ndarray) -> TemporalMatches:
        return self.frontend.follow([self.search], [start], left, right)[0]


@pytest.fixture(scope="module")
def carried(demo: Demo) -> Carried:
    _, frames, _ = demo
    frontend = build_frontend("learned", 1000, threads=1)
    key, view = (frontend.observe(frame.left, frame.right) for frame in frames[10:12])
    index = np.flatnonzero(np.isfinite(key.disparity))
    count, points = len(index), key.features.keypoints[index].astype(np.float64)
    maps = PatchMaps(np.tile(np.eye(2), (count, 1, 1)), np.zeros((count, 2)))
    covariance = np.tile(SIGMA**2 * np.eye(2), (count, 1, 1))
    search = KeypointSearch(key, index, points, covariance, maps, key.disparity[index])
    places, found = lucas_kanade(key.left, view.left, points, points, 15, 3)
    start = np.where(found[:, None], places, np.nan)
    return Carried(frontend, search, start, view, frontend.match(search, view))


def nowhere(start: np.ndarray) -> np.ndarray:
    return np.full_like(start, np.nan)


def noise(image: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, image.shape).astype(np.uint8)


def elsewhere(image: np.ndarray) -> np.ndarray:
    """Another part of the image at every place."""
    return np.roll(image, [side // 2 for side in image.shape], axis=(0, 1))


@pytest.mark.parametrize("start_of", [lambda start: start, nowhere], ids=["from optical flow", "from nowhere"])
def test_landmarks_are_followed_to_where_they_are_matched(
    carried: Carried, start_of: Callable[[np.ndarray], np.ndarray]
):
    """By a frame, in which they move by 2 pixels."""
    view, matched = carried.view, carried.matched
    followed = carried.follow(start_of(carried.start), view.left, view.right)
    assert len(followed) > 0.97 * len(carried.search.index) > len(matched) > 700
    _, a, b = np.intersect1d(followed.key_index, matched.key_index, return_indices=True)
    assert len(a) > 0.97 * len(matched)
    apart = np.linalg.norm(followed.points[a] - matched.points[b], axis=1)
    assert (apart < 1.0).mean() > 0.98
    assert np.median(apart) < 0.02
    # Disparities are searched for from those predicted, or along the whole row.
    both = np.isfinite(followed.disparity[a]) & np.isfinite(matched.disparity[b])
    assert both.mean() > 0.95
    differ = np.abs(followed.disparity[a] - matched.disparity[b])[both]
    assert np.median(differ) < 0.05
    assert (differ < 1.0).mean() > 0.98


def test_what_is_followed_has_a_probability_and_a_covariance(carried: Carried):
    followed = carried.follow(carried.start, carried.view.left, carried.view.right)
    assert ((followed.probability >= 0.5) & (followed.probability <= 1.0)).all()
    assert (np.linalg.eigvalsh(followed.covariance)[:, 0] > 0).all()
    np.testing.assert_array_equal(np.isfinite(followed.disparity), np.isfinite(followed.disparity_sigma))
    assert np.nanmin(followed.disparity_sigma) > 0
    assert len(np.unique(followed.key_index)) == len(followed)
    assert np.isin(followed.key_index, carried.search.index).all()


def test_landmarks_of_two_keyframes_are_followed_as_those_of_one(carried: Carried):
    """Their neighbours are among each other's."""
    view, rows = carried.view, np.arange(len(carried.search.index))
    parts = [rows[::2], rows[1::2]]
    searches = [select(carried.search, part) for part in parts]
    found = carried.frontend.follow(searches, [carried.start[part] for part in parts], view.left, view.right)
    whole = carried.follow(carried.start, view.left, view.right)
    key_index = np.concatenate([matches.key_index for matches in found])
    np.testing.assert_array_equal(np.sort(key_index), np.sort(whole.key_index))
    points = np.concatenate([matches.points for matches in found])
    np.testing.assert_allclose(points[np.argsort(key_index)], whole.points[np.argsort(whole.key_index)])
    for matches, part in zip(found, parts, strict=True):
        assert np.isin(matches.key_index, carried.search.index[part]).all()


def select(search: KeypointSearch, rows: np.ndarray) -> KeypointSearch:
    assert search.covariance is not None
    assert search.maps is not None
    assert search.disparity is not None
    return replace(
        search,
        index=search.index[rows],
        predicted=search.predicted[rows],
        covariance=search.covariance[rows],
        maps=search.maps.select(rows),
        disparity=search.disparity[rows],
    )


@pytest.mark.parametrize("start_of", [lambda start: start, nowhere], ids=["from optical flow", "from nowhere"])
@pytest.mark.parametrize("image_of", [noise, elsewhere])
def test_next_to_nothing_is_followed_into_another_image(
    carried: Carried,
    image_of: Callable[[np.ndarray], np.ndarray],
    start_of: Callable[[np.ndarray], np.ndarray],
):
    """Alignment alone would find one landmark in eight in the other part of the demo's image."""
    image = image_of(carried.view.left)
    assert len(carried.follow(start_of(carried.start), image, image)) < 0.03 * len(carried.search.index)


def test_next_to_nothing_has_a_disparity_to_noise(carried: Carried):
    observed = carried.frontend.observe(carried.view.left, noise(carried.view.left))
    assert np.isfinite(observed.disparity).sum() + len(observed.behind) < 0.03 * len(observed.disparity)


@pytest.mark.parametrize(("image_of", "most"), [(noise, 0.2), (elsewhere, 0.1)])
def test_of_predicted_disparities_few_are_confirmed_by_another_image(
    carried: Carried, image_of: Callable[[np.ndarray], np.ndarray], most: float
):
    """What lies within 3 pixels of a good prediction is mostly right, whatever the patches say: some are believed."""
    followed = carried.follow(carried.start, carried.view.left, image_of(carried.view.left))
    assert len(followed) > 0.97 * len(carried.search.index)
    assert np.isfinite(followed.disparity).mean() < most
    assert np.nanmedian(followed.disparity_sigma) > 0.5


def test_nothing_is_followed_into_a_blank_image_and_no_search_has_no_matches(carried: Carried):
    blank = np.full_like(carried.view.left, 90)
    assert len(carried.follow(carried.start, blank, blank)) == 0
    assert carried.frontend.follow([], [], carried.view.left, carried.view.right) == []


@pytest.mark.parametrize("missing", ["maps", "disparity"])
def test_a_search_without_predicted_patches_or_disparities_is_refused(carried: Carried, missing: str):
    search = replace(carried.search, **{missing: None})
    with pytest.raises(ValueError, match="with a prediction of their places, patches and disparities"):
        carried.frontend.follow([search], [carried.start], carried.view.left, carried.view.right)


def test_places_beside_the_true_ones_are_improbable(carried: Carried):
    """Six pixels beside them in any direction, three in ten places at a time."""
    key, view, matched = carried.search.key, carried.view, carried.matched
    points = key.features.keypoints[matched.key_index].astype(np.float64)
    rng = np.random.default_rng(0)
    wrong, angle = rng.random(len(points)) < 0.3, rng.uniform(0.0, 2.0 * np.pi, len(points))
    aside = 6.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    places = matched.points + np.where(wrong[:, None], aside, 0.0)
    evidence = examine_patches(key.left, view.left, points, places)
    sigma0 = key.features.sigma[matched.key_index]
    probability, _ = ConfidenceEstimator().verify_places(places, points, evidence, sigma0, PlaceSearch.IN_TIME)
    assert (probability[~wrong] > 0.5).mean() > 0.97
    assert (probability[wrong] > 0.5).mean() < 0.03

"""What the verifiers are told: values counted by hand, and finite ones whatever the patches are."""

import numpy as np
import pytest

from sigmaslam.frontend.patch_evidence import Evidence, examine_patches
from sigmaslam.frontend.types import Refinement
from sigmaslam.frontend.verifier_inputs import PlaceSearch, describe_matches, describe_places

COUNT = 5
LOGIT, CORRELATION, CONTRAST0, CONTRAST1, SHARPNESS, SHIFT, MOVED, MAPPED = 0, 1, 2, 3, [4, 5], [6, 7], 8, 9
SIGMA0, SIGMA1, SPACING, DISTANCE = 10, 11, 12, 13


def evidence(**changed: np.ndarray) -> Evidence:
    """Of five like matches on an edge that leans by 30 degrees, image 1 twice as large, but for what is changed."""
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    values = {
        "correlation": np.full(COUNT, 0.8),
        "contrast0": np.full(COUNT, 20.0),
        "contrast1": np.full(COUNT, 30.0),
        "sharpness": np.tile([0.3, 0.01], (COUNT, 1)),
        "axes": np.tile([[cosine, -sine], [sine, cosine]], (COUNT, 1, 1)),
        "spacing": np.full(COUNT, 2.0),
        "zoom": np.full(COUNT, 2.0),
    }
    return Evidence(**(values | changed))


def refinement(moves: np.ndarray | None = None, distance: np.ndarray | None = None) -> Refinement:
    start = np.random.default_rng(0).uniform(0, 100, (COUNT, 2))
    moves = np.zeros((COUNT, 2)) if moves is None else moves
    A = None if distance is None else np.tile(2.0 * np.eye(2), (COUNT, 1, 1))
    return Refinement(start, start + moves, np.arange(COUNT) % 2 == 0, A, distance)


def columns(
    of: Evidence | None = None,
    moved: Refinement | None = None,
    logit: float = 1.0,
    sigma: tuple[float, float] = (0.5, 0.7),
) -> np.ndarray:
    return describe_matches(
        np.full(COUNT, logit), of or evidence(), moved or refinement(), *(np.full(COUNT, each) for each in sigma)
    )


def test_a_match_is_fourteen_float32_numbers():
    found = columns()
    assert found.shape == (COUNT, 14)
    assert found.dtype == np.float32
    none = np.zeros(0)
    nothing = Evidence(none, none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none)
    nowhere = Refinement(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    assert describe_matches(none, nothing, nowhere, none, none).shape == (0, 14)


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (LOGIT, 1.0 / 4.0),
        (CORRELATION, np.log(0.101)),
        (CONTRAST0, np.log(20.0)),
        (CONTRAST1, np.log(30.0)),
        (SHARPNESS, np.log([0.301, 0.011])),
        (SHIFT, 0.0),
        (MOVED, [1.0, 0.0, 1.0, 0.0, 1.0]),
        (MAPPED, 0.0),
        (SIGMA0, np.log(2.0 * 0.5 + 0.05)),
        (SIGMA1, np.log(0.75)),
        (SPACING, np.log(2.0)),
        (DISTANCE, 0.0),
    ],
)
def test_columns_have_the_values_counted_by_hand(column: int | list[int], expected: float | list[float]):
    found = columns()[:, column]
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-5, atol=1e-6)


def test_moves_are_counted_along_the_axes_in_samples_whatever_their_sign():
    axes = evidence().axes[0]
    moves = np.outer([3.0, -3.0, 0.0, 0.0, 2.0], axes[:, 0]) + np.outer([0.0, 0.0, 1.0, -1.0, -4.0], axes[:, 1])
    found = np.expm1(columns(moved=refinement(moves))[:, SHIFT])
    np.testing.assert_allclose(found, np.array([[3, 0], [3, 0], [0, 1], [0, 1], [2, 4]]) / 2.0, atol=1e-5)


def test_the_neighbours_map_is_told_and_far_is_far_enough():
    found = columns(moved=refinement(distance=np.array([0.0, 1.0, 50.0, 1e6, np.inf])))
    assert (found[:, MAPPED] == 1.0).all()
    np.testing.assert_allclose(np.expm1(found[:, DISTANCE]), [0.0, 1.0, 50.0, 50.0, 50.0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("logit", "expected"), [(3.0, 0.75), (1e6, 2.0), (-np.inf, -2.0)])
def test_a_logit_beyond_reason_is_bounded(logit: float, expected: float):
    np.testing.assert_allclose(columns(logit=logit)[:, LOGIT], expected)


@pytest.mark.parametrize("correlation", [1.0, 1.0 + 1e-6, -1.0, 0.0])
def test_any_correlation_is_finite(correlation: float):
    assert np.isfinite(columns(evidence(correlation=np.full(COUNT, correlation)))).all()


def test_no_contrast_no_edges_and_no_sigma_are_finite():
    flat = evidence(contrast0=np.ones(COUNT), contrast1=np.ones(COUNT), sharpness=np.zeros((COUNT, 2)))
    assert np.isfinite(columns(flat, sigma=(0.0, 0.0))).all()


def degenerate(images: str) -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(1).integers(0, 256, (60, 60), np.uint8)
    flat, saturated = np.full_like(noise, 90), np.where(noise > 127, 255, 0).astype(np.uint8)
    pairs = {
        "flat": (flat, flat),
        "one of them flat": (noise, flat),
        "the same": (noise, noise),
        "saturated": (saturated, 255 - saturated),
    }
    return pairs[images]


@pytest.mark.parametrize("images", ["flat", "one of them flat", "the same", "saturated"])
def test_columns_of_degenerate_images_are_finite(images: str):
    moved = refinement()
    found = describe_matches(
        np.random.default_rng(1).standard_normal(COUNT),
        examine_patches(*degenerate(images), moved.start, moved.places),
        moved,
        np.ones(COUNT),
        np.ones(COUNT),
    )
    assert np.isfinite(found).all()
    assert found.shape == (COUNT, 14)


# Places


PLACE_SPREAD, PLACE_DEPARTURE, TEMPORAL, PREDICTED, PLACE_SIGMA, PLACE_SPACING = 0, [6, 7], 8, 9, 10, 11


def place_columns(
    departure: np.ndarray | None = None,
    spread: float = 0.4,
    sigma: float = 0.5,
    search: PlaceSearch = PlaceSearch.IN_TIME,
) -> np.ndarray:
    departure = np.zeros((COUNT, 2)) if departure is None else departure
    return describe_places(departure, np.full(COUNT, spread), evidence(), np.full(COUNT, sigma), search)


def test_a_place_is_twelve_float32_numbers():
    found = place_columns()
    assert found.shape == (COUNT, 12)
    assert found.dtype == np.float32
    none = np.zeros(0)
    nothing = Evidence(none, none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none)
    assert describe_places(np.zeros((0, 2)), none, nothing, none, PlaceSearch.ALONG_ROWS).shape == (0, 12)


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (PLACE_SPREAD, np.log(0.5)),
        (CORRELATION, np.log(0.101)),
        (CONTRAST0, np.log(20.0)),
        (CONTRAST1, np.log(30.0)),
        (SHARPNESS, np.log([0.301, 0.011])),
        (PLACE_DEPARTURE, 0.0),
        (TEMPORAL, 1.0),
        (PREDICTED, 1.0),
        (PLACE_SIGMA, np.log(2.0 * 0.5 + 0.05)),
        (PLACE_SPACING, np.log(2.0)),
    ],
)
def test_columns_of_places_have_the_values_counted_by_hand(column: int | list[int], expected: float | list[float]):
    found = place_columns()[:, column]
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-5, atol=1e-6)


def test_departures_are_counted_along_the_axes_in_samples_and_far_is_far_enough():
    axes = evidence().axes[0]
    departure = np.outer([3.0, -3.0, 0.0, 1e6, 2.0], axes[:, 0]) + np.outer([0.0, 0.0, 1.0, 0.0, -4.0], axes[:, 1])
    found = np.expm1(place_columns(departure)[:, PLACE_DEPARTURE])
    expected = np.array([[3, 0], [3, 0], [0, 1], [100, 0], [2, 4]]) / 2.0
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


def test_places_of_the_other_eye_are_told_from_those_of_another_time():
    in_time, along_rows, predicted = (place_columns(search=search) for search in PlaceSearch)
    told = [TEMPORAL, PREDICTED]
    for found, expected in ((in_time, (1.0, 1.0)), (along_rows, (0.0, 0.0)), (predicted, (0.0, 1.0))):
        np.testing.assert_array_equal(found[:, told], np.broadcast_to(expected, (COUNT, 2)))
        np.testing.assert_array_equal(np.delete(found, told, axis=1), np.delete(in_time, told, axis=1))


@pytest.mark.parametrize("images", ["flat", "one of them flat", "the same", "saturated"])
def test_columns_of_places_in_degenerate_images_are_finite(images: str):
    rng = np.random.default_rng(1)
    points, places = rng.uniform(-5, 65, (2, COUNT, 2))
    found_evidence = examine_patches(*degenerate(images), points, places)
    found = describe_places(places - points, np.zeros(COUNT), found_evidence, np.zeros(COUNT), PlaceSearch.IN_TIME)
    assert np.isfinite(found).all()
    assert found.shape == (COUNT, 12)

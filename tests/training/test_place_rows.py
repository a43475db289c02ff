"""What the verifier of places learns from: columns and errors of keypoints found in pairs whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sigmaslam.frontend.nearest_neighbours import Putative
from sigmaslam.frontend.types import Features
from sigmaslam_models.verifier_network import PLACE_COLUMNS
from sigmaslam_synthetic.rendering.textures import dead_leaves
from sigmaslam_training.matching import place_rows
from sigmaslam_training.matching.match_sets import MatchSet, PairRecord
from sigmaslam_training.matching.place_rows import collect_place_rows
from sigmaslam_training.matching.verifier_training import VerifierRows

COUNT, HIDDEN, SIDE, MARGIN = 200, 50, 300, 20
TEMPORAL = 8
# From image 0 to image 1, whole pixels.
SHIFTS = {"stereo": (-12, 0), "scenes": (6, -4), "planes": (6, -4)}


def record(source: str, seed: int = 0, kinds: tuple[str, ...] = ("sift",)) -> PairRecord:
    """A texture and the same moved, each with noise; a quarter of the corners is called hidden."""
    rng = np.random.default_rng(seed)
    texture = dead_leaves((SIDE + 2 * MARGIN, SIDE + 2 * MARGIN), rng)
    u, v = SHIFTS[source]
    views = [texture[MARGIN - dv :, MARGIN - du :][:SIDE, :SIDE] for du, dv in ((0, 0), (u, v))]
    images = [np.clip(np.round(view + rng.normal(0.0, 1.0, view.shape)), 0, 255).astype(np.uint8) for view in views]
    inner = np.zeros_like(images[0])
    inner[30:-30, 30:-30] = 1
    keypoints = cv2.goodFeaturesToTrack(images[0], COUNT, 0.001, 3.0, mask=inner)[:, 0]
    ones = np.ones(COUNT, np.float32)
    features0 = Features(keypoints, np.zeros((COUNT, 0), np.float32), ones, ones)
    none, nothing = np.zeros(0, np.int64), np.zeros(0, np.float32)
    putative = Putative(none, none, nothing, nothing, nothing)
    visible = rng.permutation(COUNT) >= HIDDEN
    expected = keypoints.astype(np.float64) + (u, v)
    found = MatchSet(source, features0, features0.select(none), putative, expected, visible)
    return PairRecord(images[0], images[1], dict.fromkeys(kinds, found))


def collect(records: list[PairRecord], seed: int = 0) -> VerifierRows:
    return collect_place_rows(records, seed, lambda done: None)


def far(rows: VerifierRows) -> np.ndarray:
    """(M,) bool, further off than an image is large: there is no truth."""
    return np.asarray(np.linalg.norm(rows.error, axis=1) > 900.0)


@pytest.fixture
def no_foreign_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(place_rows, "_FOREIGN", 0.0)


@pytest.mark.usefixtures("no_foreign_pairs")
@pytest.mark.parametrize("source", SHIFTS)
def test_errors_are_small_where_keypoints_are_seen_and_very_large_where_they_are_hidden(source: str):
    rows = collect([record(source, seed) for seed in range(4)])
    hidden = far(rows)
    assert hidden.mean() == pytest.approx(HIDDEN / COUNT, abs=0.05)
    assert not rows.right[hidden].any()
    assert rows.right[~hidden].mean() > 0.95
    assert np.median(np.linalg.norm(rows.error[~hidden], axis=1)) < 0.1


@pytest.mark.usefixtures("no_foreign_pairs")
@pytest.mark.parametrize(("source", "times"), [("stereo", 2), ("scenes", 1), ("planes", 1)])
def test_keypoints_are_searched_for_along_rows_and_from_predictions_or_followed(source: str, times: int):
    """Eyes are told from times by a column; most keypoints are found."""
    done: list[int] = []
    rows = collect_place_rows([record(source), record(source, 1, ("sift", "orb"))], 0, done.append)
    assert done == [1, 2]
    assert rows.inputs.shape == (len(rows.pair), PLACE_COLUMNS)
    assert rows.inputs.dtype == rows.error.dtype == np.float32
    assert np.isfinite(rows.inputs).all()
    assert np.isfinite(rows.error).all()
    assert (rows.inputs[:, TEMPORAL] == (source != "stereo")).all()
    for count, sets in zip(np.bincount(rows.pair), (1, 2), strict=True):
        assert 0.5 * COUNT * times * sets < count <= COUNT * times * sets


@pytest.mark.parametrize("source", SHIFTS)
def test_of_a_pair_of_another_place_all_that_is_found_is_wrong(source: str, monkeypatch: pytest.MonkeyPatch):
    records = [record(source, seed) for seed in range(4)]
    monkeypatch.setattr(place_rows, "_MIN_ROWS", 1)
    monkeypatch.setattr(place_rows, "_FOREIGN", 0.0)
    true = collect(records)
    monkeypatch.setattr(place_rows, "_FOREIGN", 1.0)
    foreign = collect(records)
    assert far(foreign).all()
    assert not foreign.right.any()
    assert 0 < len(foreign.pair) < 0.5 * len(true.pair)
    # The first of the appearance columns is the log of half the squared difference of the patches.
    assert np.median(foreign.inputs[:, 1]) > np.median(true.inputs[:, 1]) + 1.0


@pytest.mark.long
def test_so_many_pairs_are_foreign():
    """About one in seven."""
    records = [record("scenes")] * 60
    rows = collect(records)
    foreign = np.array([far(rows)[rows.pair == number].all() for number in range(60)])
    assert 3 <= foreign.sum() <= 17


@pytest.mark.usefixtures("no_foreign_pairs")
def test_what_hardly_finds_anything_is_left_out():
    few, many = record("scenes"), record("scenes", 1)
    found, rows = few.sets["sift"], np.arange(15)
    some = replace(
        found, features0=found.features0.select(rows), expected=found.expected[rows], visible=found.visible[rows]
    )
    pairs = collect([PairRecord(few.image0, few.image1, {"sift": some}), many]).pair
    assert np.unique(pairs).tolist() == [1]


def test_rows_depend_on_the_seed_and_the_number_of_their_record_alone():
    records = [record("stereo"), record("scenes"), record("scenes")]
    first, again, other = collect(records), collect(records), collect(records, seed=1)
    for a, b in zip(first.columns(), again.columns(), strict=True):
        np.testing.assert_array_equal(a, b)
    part = collect(records[:2])
    np.testing.assert_array_equal(first.select(first.pair < 2).inputs, part.inputs)

    def inputs(rows: VerifierRows, number: int) -> list[float]:
        return rows.inputs[rows.pair == number].ravel().tolist()

    assert inputs(first, 1) != inputs(other, 1)
    # The same pair twice: each time with other predictions.
    assert inputs(first, 1) != inputs(first, 2)

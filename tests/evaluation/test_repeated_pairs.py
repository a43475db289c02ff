"""Pairs of repeated structure: exact truth, and places that look alike a period apart."""

import cv2
import numpy as np
import pytest

from sigmaslam_benchmarks.matching import repeated_pairs
from sigmaslam_benchmarks.matching.repeated_pairs import RepeatedPairs
from sigmaslam_synthetic.camera.sensor import Sensor

SIZE = 128


@pytest.fixture
def clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planes full of the pattern, shifted only, through a sensor without noise."""
    monkeypatch.setattr(
        repeated_pairs, "random_sensor", lambda rng: Sensor(blur=0.0, read_noise=0.0, photons_at_white=1e9)
    )
    monkeypatch.setattr(repeated_pairs, "_STILL", 1.0)
    monkeypatch.setattr(repeated_pairs, "_BOARDS", 0.0)
    monkeypatch.setattr(repeated_pairs, "_PERIODS", (16.0, 16.4))


def test_a_pair_is_a_function_of_seed_and_index():
    first, second = RepeatedPairs(1, SIZE), RepeatedPairs(1, SIZE)
    second.pair(4)
    for a, b in ((first.pair(2), second.pair(2)),):
        np.testing.assert_array_equal(a.image0, b.image0)
        np.testing.assert_array_equal(a.H_1_0, b.H_1_0)
    assert np.abs(RepeatedPairs(2, SIZE).pair(2).image0 - first.pair(2).image0).mean() > 1e-3


@pytest.mark.usefixtures("clean")
def test_the_true_place_shows_what_is_seen_and_so_does_any_period_beside_it():
    for index in range(6):
        pair = RepeatedPairs(1, SIZE).pair(index)
        for periods in ((0, 0), (1, 0), (0, -1), (-1, 1)):
            H = pair.H_1_0.copy()
            H[:2, 2] += 16 * np.array(periods)
            back = cv2.warpPerspective(pair.image1, np.linalg.inv(H), (SIZE, SIZE))
            seen = cv2.warpPerspective(np.ones_like(pair.image1), np.linalg.inv(H), (SIZE, SIZE)) == 1.0
            seen[:4] = seen[-4:] = seen[:, :4] = seen[:, -4:] = False
            assert seen.sum() > 1000
            assert np.abs(back - pair.image0)[seen].mean() < 0.02, (index, periods)


@pytest.mark.long
def test_shifts_by_whole_periods_other_shifts_and_warps_are_all_drawn():
    kinds = {"warped": 0, "shifted": 0}
    for index in range(40):
        H = RepeatedPairs(1, SIZE).pair(index).H_1_0
        kinds["shifted" if np.allclose(H[:2, :2], np.eye(2)) else "warped"] += 1
    assert min(kinds.values()) >= 10

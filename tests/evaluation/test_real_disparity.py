from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.reconstruction.disparity import DisparityMap, measure_disparity, row_offset, semi_global_disparity
from sigmaslam_benchmarks.tracking import real_disparity
from sigmaslam_benchmarks.tracking.disparity_pairs import DisparityPair, real_pairs, worse_camera
from sigmaslam_benchmarks.tracking.real_disparity import edge_distance, judge, scan_shift, write_real
from tests.support.textured_pairs import textured_pair


def _pair(disparity: float = 7.4, focal_baseline: float | None = None) -> DisparityPair:
    truth = np.full((120, 200), disparity, np.float32)
    left, right = textured_pair(truth, noise=1.0)
    return DisparityPair(left, right, truth, np.full_like(truth, 0.05), focal_baseline)


def test_the_time_of_a_scan_is_found_whatever_a_fifth_of_the_disparities_is():
    rng = np.random.default_rng(1)
    distance = rng.uniform(3.0, 40.0, 4000)
    disparity = 400.0 / (distance + 0.07) + 0.1 * rng.standard_normal(4000)
    disparity[::5] = 50.0
    disparity[::7] = np.nan
    assert scan_shift(disparity, distance, 400.0) == pytest.approx(0.07, abs=0.011)


def test_an_edge_is_where_two_surfaces_meet_and_no_slant_is():
    truth = np.full((40, 80), 10.0, np.float32)
    truth[:, 50:] = 20.0
    truth[::2] = np.nan
    found = edge_distance(truth)
    assert found[21, 50] == 0.0
    assert found[21, 20] == pytest.approx(26.0, abs=0.5)
    slanted = np.broadcast_to(10.0 + 0.1 * np.arange(80, dtype=np.float32), (40, 80))
    assert edge_distance(slanted).min() > 1000.0


def test_errors_of_a_known_size_are_inside_as_a_normal_law_says():
    pair = _pair()
    rng = np.random.default_rng(2)

    def match(left: np.ndarray, right: np.ndarray) -> DisparityMap:
        noise = np.hypot(0.3, 0.05) * rng.standard_normal(left.shape)
        return DisparityMap(pair.truth + noise.astype(np.float32), np.full(left.shape, 0.09, np.float32))

    found, seconds = judge([pair, pair], match)
    assert seconds >= 0.0
    assert len(found) == 2 * pair.truth.size
    assert np.mean(found.deviations < 1.0) == pytest.approx(0.683, abs=0.01)
    assert np.mean(found.deviations < 2.0) == pytest.approx(0.954, abs=0.01)


def test_a_worse_camera_moves_rows_and_keeps_the_disparities():
    pair = _pair()
    worse = worse_camera(pair, np.random.default_rng(3))
    found = measure_disparity(worse.left, worse.right, semi_global_disparity).disparity - pair.truth
    assert abs(np.nanmedian(found[10:-10, 30:-10])) < 0.05
    rows = [
        row_offset(each.left.astype(np.float32), each.right.astype(np.float32), pair.truth) for each in (pair, worse)
    ]
    assert np.abs(rows[0]).max() < 0.05 < np.abs(rows[1]).max()


@pytest.mark.long
def test_the_page_has_every_set_and_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(real_disparity, "real_pairs", lambda data: {"drive": [_pair(20.0, 400.0)]})

    def rendered(seeds: tuple[int, ...], worlds: tuple[str, ...] = ("street", "room")) -> dict[str, Any]:
        return {world: [_pair()] for world in worlds}

    monkeypatch.setattr(real_disparity, "real_pairs", lambda data: {"drive": [_pair(20.0, 400.0)]})
    monkeypatch.setattr(real_disparity, "rendered_pairs", rendered)
    # The images are smaller than a tile of the spectrum.
    monkeypatch.setattr(real_disparity, "_look", lambda name, pairs: [name, str(len(pairs))])
    page = write_real(tmp_path / "page.md", tmp_path, "command")
    assert page.count("| drive | ours |") == 1
    assert page.count("| drive | SGBM") == 2
    with (tmp_path / "page.renders.csv").open() as table:
        renders = [(name, method[:4]) for name, method, *_ in list(csv.reader(table))[1:]]
    names = "street", "room", "street, worse camera", "room, worse camera", "street, detailed"
    assert renders == [(name, each) for name in names for each in ("ours", "SGBM", "SGBM")]
    assert "| street, detailed | 1 |" in page
    assert cv2.imread(str(tmp_path / "page.jpg")).shape[1] == 621
    assert "Ours on the drive, by distance, metres:" in page
    distances = (tmp_path / "page.by-distance.csv").read_text()
    assert "\n10,20," not in distances
    assert "\n20,40,100.0%," in distances


def test_data_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(InputError, match="lidar"):
        real_pairs(tmp_path)

"""Rows of records by one process and by two."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import SigmaSlamError
from sigmaslam.training.matching.match_sets import PairRecord, record_path, save_record
from sigmaslam.training.matching.row_collection import collect_rows
from sigmaslam.training.matching.verifier_training import VerifierRows


def saved(folder: Path, count: int) -> list[Path]:
    paths = [record_path(folder, index) for index in range(count)]
    for index, path in enumerate(paths):
        image = np.full((8, 8), 10 * index, np.uint8)
        save_record(path, PairRecord(image, image, {}))
    return paths


def greys(record: PairRecord, number: int) -> list[VerifierRows]:
    """Two rows of the grey of the image."""
    grey = np.full((2, 3), record.image0.mean(), np.float32)
    return [VerifierRows(grey, grey[:, :2], np.full(2, number))]


def nothing(record: PairRecord, number: int) -> list[VerifierRows]:
    return []


def test_rows_are_in_the_order_of_the_records_and_each_is_told(tmp_path: Path):
    done: list[int] = []
    rows = collect_rows(saved(tmp_path, 3), greys, 1, done.append)
    assert done == [1, 2, 3]
    assert rows.pair.tolist() == [0, 0, 1, 1, 2, 2]
    assert rows.inputs[:, 0].tolist() == [0, 0, 10, 10, 20, 20]


def test_no_rows_are_an_error(tmp_path: Path):
    with pytest.raises(SigmaSlamError, match=f"no match likely in any pair of {tmp_path}"):
        collect_rows(saved(tmp_path, 1), nothing, 1, lambda done: None)


@pytest.mark.slow
def test_two_processes_make_the_same_rows(tmp_path: Path):
    paths = saved(tmp_path, 5)
    one, two = (collect_rows(paths, greys, workers, lambda done: None) for workers in (1, 2))
    for a, b in zip(one.columns(), two.columns(), strict=True):
        np.testing.assert_array_equal(a, b)

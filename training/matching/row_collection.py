"""Rows of many records for a verifier, made by several processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

from sigmaslam.errors import SigmaSlamError
from sigmaslam.training.features.stream import prepare_worker
from sigmaslam.training.matching.match_sets import PairRecord, load_record
from sigmaslam.training.matching.verifier_training import VerifierRows

_CHUNK = 4

RowsOf = Callable[[PairRecord, int], list[VerifierRows]]
"""Rows of a record and its number; where there are several processes it must be picklable."""


def collect_rows(paths: list[Path], rows_of: RowsOf, workers: int, note: Callable[[int], None]) -> VerifierRows:
    """The rows of all records, in their order whatever the number of processes.

    Args:
        paths: of the records, which are numbered in this order.
        rows_of: makes the rows of one.
        workers: processes; 1: this one.
        note: is told how many records are done.
    Raises:
        SigmaSlamError: there are no rows, or a process died.
    """
    parts: list[VerifierRows] = []
    try:
        for done, of_record in enumerate(_made(paths, rows_of, workers), start=1):
            parts += of_record
            note(done)
    except BrokenProcessPool as error:
        raise SigmaSlamError(
            f"a process that refines matches of {paths[0].parent} died: run the same command again"
        ) from error
    if not parts:
        raise SigmaSlamError(
            f"the scorer finds no match likely in any pair of {paths[0].parent}: train it longer, or on more pairs"
        )
    return VerifierRows.concatenate(parts)


def _made(paths: list[Path], rows_of: RowsOf, workers: int) -> Iterator[list[VerifierRows]]:
    task = partial(_rows_of_file, rows_of=rows_of)
    numbered: Iterable[tuple[int, Path]] = enumerate(paths)
    if workers == 1:
        yield from map(task, numbered)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, prepare_worker, (0,)) as pool:
        try:
            yield from pool.map(task, numbered, chunksize=_CHUNK)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _rows_of_file(numbered: tuple[int, Path], rows_of: RowsOf) -> list[VerifierRows]:
    number, path = numbered
    return rows_of(load_record(path), number)

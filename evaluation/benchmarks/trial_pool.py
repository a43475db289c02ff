"""Sequences of a benchmark in processes, one at a time each."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

import cv2
import torch

Job = TypeVar("Job")


def run_trials(
    make: Callable[[Job], str], missing: Sequence[Job], count: int, workers: int, note: Callable[[str], None]
) -> None:
    """Does what is missing, in processes of one thread each.

    Args:
        make: a function of a module, which does one job and says what it did.
        missing: jobs to do.
        count: of all jobs, those that are done included.
        workers: processes.
        note: is told of progress.
    """
    note(f"{count - len(missing)} of {count} sequences are there")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(len(missing), 1)), context, _start_worker) as pool:
        try:
            futures = [pool.submit(_work, make, job) for job in missing]
            for done, future in enumerate(as_completed(futures), start=1):
                note(f"{done} of {len(missing)}: {future.result()}")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _start_worker() -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _work(make: Callable[[Job], str], job: Job) -> str:
    try:
        return make(job)
    except KeyboardInterrupt:
        os._exit(130)  # or this process would begin with the next sequence

"""Independent jobs in parallel: in processes of this machine, or as tasks of a Ray cluster."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import Any, TypeVar

import cv2
import torch

from sigmaslam.errors import InputError

RETRIES = 3
"""How many times a job is done again whose worker died."""

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    workers: int,
    ended: Callable[[Job, Result | Exception], None],
    ray: str | None = None,
    gpus: int = 0,
) -> None:
    """Does each job in a worker process of one thread.

    When a worker dies (killed, out of memory, its machine lost) its job is done again, so a job must leave its files
    whole or not at all. After an exception of a job the other jobs go on.

    Args:
        work: a function of a module; it, the jobs and the results are pickled.
        jobs: what it is called with.
        workers: processes of this machine, those of Ray's address 'local' included.
        ended: is called here with each job and its result, or the exception in its place, in the order in which jobs
            end. What it raises stops all.
        ray: None: a process pool. Else the address that `ray.init` takes: 'local' starts Ray on this machine; 'auto'
            and HOST:PORT join a cluster, where all processors work. A Ray that this process has started is used.
        gpus: that a job needs, for Ray.
    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    if jobs and ray is None:
        _run_in_pool(work, jobs, workers, ended)
    elif jobs and ray is not None:
        _run_on_ray(work, jobs, workers, ended, ray, gpus)


def list_failures(failed: Mapping[str, Exception]) -> str:
    """Jobs by name, each with the exception that ended it."""
    return "; ".join(f"{name} ({type(error).__name__}: {error})" for name, error in failed.items())


def _run_in_pool(
    work: Callable[[Job], Result], jobs: Sequence[Job], workers: int, ended: Callable[[Job, Result | Exception], None]
) -> None:
    for retries in range(RETRIES, -1, -1):
        unfinished = []
        with ProcessPoolExecutor(min(workers, len(jobs)), get_context("spawn"), _end_with_parent) as pool:
            try:
                futures = {pool.submit(_do, work, job): job for job in jobs}
                for future in as_completed(futures):
                    # With one worker the whole pool is gone, and its other jobs with it.
                    if retries and isinstance(future.exception(), BrokenProcessPool):
                        unfinished.append(futures[future])
                    else:
                        ended(futures[future], _outcome(future.result))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        if not unfinished:
            return
        jobs = unfinished


def _run_on_ray(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    workers: int,
    ended: Callable[[Job, Result | Exception], None],
    address: str,
    gpus: int,
) -> None:
    try:
        import ray
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[scale]'") from error
    start = not ray.is_initialized()
    if start:
        local: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False} if address == "local" else {}
        try:
            ray.init(address, log_to_driver=False, **local)
        except Exception as error:  # Ray's own are bare ones, too
            raise InputError(
                f"Ray at {address!r} cannot be used ({error}): give HOST:PORT of a cluster that 'ray start --head' has "
                "started, or 'local', which starts one here"
            ) from error
    try:
        get: Callable[[Any], Result] = ray.get
        task: Any = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)(_do)
        pending = {task.remote(work, job): job for job in jobs}
        while pending:
            for reference in ray.wait(list(pending))[0]:
                ended(pending.pop(reference), _outcome(partial(get, reference)))
    finally:
        if start:
            ray.shutdown()  # which also ends the tasks that are left


def _outcome(result: Callable[[], Result]) -> Result | Exception:
    """A result that is there, or the exception in its place; Ray wraps those of jobs."""
    try:
        return result()
    except Exception as error:
        return getattr(error, "cause", None) or error


def _end_with_parent() -> None:
    """Ends this worker when its parent is killed: nobody would take what it makes."""

    def wait() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def _do(work: Callable[[Job], Result], job: Job) -> Result:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    try:
        return work(job)
    except KeyboardInterrupt:
        os._exit(130)  # or this process would begin with the next job

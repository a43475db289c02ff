"""Jobs in processes and on Ray: each ends once, whatever becomes of a worker."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sigmaslam.errors import InputError
from sigmaslam_synthetic.parallel_jobs import RETRIES, list_failures, run_jobs
from sigmaslam_synthetic.render_sequence import write_sequence, write_sequences
from sigmaslam_synthetic.simulation import Recipe
from tests.support.parallel_work import die, die_once, sleep_beside_another, square

TINY = Recipe("organ", 3, 5, width=48, height=36)


@pytest.fixture(scope="module", params=["pool", pytest.param("ray", marks=pytest.mark.slow)])
def ray_address(request: pytest.FixtureRequest) -> Iterator[str | None]:
    """Where jobs run: a process pool, or one Ray of two processors for all tests here."""
    if request.param == "pool":
        yield None
        return
    ray = pytest.importorskip("ray")
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield "local"
    ray.shutdown()


def outcomes(work: Callable[[Any], Any], jobs: list[Any], ray: str | None, workers: int = 2) -> list[tuple[Any, Any]]:
    ended: list[tuple[Any, Any]] = []
    run_jobs(work, jobs, workers, lambda job, outcome: ended.append((job, outcome)), ray)
    return ended


# Before a test that starts Ray, which then is the one that all use.
def test_a_cluster_that_is_not_there_is_named():
    pytest.importorskip("ray")
    with pytest.raises(InputError, match=r"Ray at 'nowhere' cannot be used .*ray start --head"):
        outcomes(square, [0], "nowhere")


@pytest.mark.long
def test_a_job_that_fails_is_handed_over_and_the_others_go_on(ray_address: str | None):
    ended = dict(outcomes(square, [0, 1, 2, 4], ray_address))
    assert {job: ended[job] for job in (0, 2, 4)} == {0: 0, 2: 4, 4: 16}
    assert isinstance(ended[1], ValueError)
    assert list_failures({"first": ended[1]}) == "first (ValueError: 1 is odd)"


@pytest.mark.long
def test_the_job_of_a_killed_worker_is_done_again_and_each_job_ends_once(ray_address: str | None, tmp_path: Path):
    jobs = [tmp_path / name for name in ("a", "killed", "b", "c")]
    ended = outcomes(die_once, jobs, ray_address)
    assert sorted(ended) == sorted((job, job.name) for job in jobs)
    assert (tmp_path / "killed").read_text() == "xx"


@pytest.mark.slow
def test_a_job_that_kills_every_worker_ends_with_an_error(ray_address: str | None, tmp_path: Path):
    ((job, outcome),) = outcomes(die, [tmp_path / "marks"], ray_address)
    assert isinstance(outcome, Exception)
    assert len(job.read_text()) == 1 + RETRIES


@pytest.mark.long
def test_two_workers_sleep_at_the_same_time(ray_address: str | None, tmp_path: Path):
    """So that jobs that compute alone on their processors are done 1.7 times as fast or more."""
    spans = [outcome for _, outcome in outcomes(sleep_beside_another, [tmp_path] * 12, ray_address)]
    begins, ends = zip(*spans, strict=True)
    assert sum(end - begin for begin, end in spans) >= 1.7 * (max(ends) - min(begins))
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.long
def test_frames_and_sequences_are_the_same_bytes_wherever_they_are_rendered(ray_address: str | None, tmp_path: Path):
    write_sequence(tmp_path / "alone" / "organ5", TINY, "sparse")
    write_sequence(tmp_path / "frames" / "organ5", TINY, "sparse", 2, ray=ray_address)
    counts: list[int] = []
    write_sequences(tmp_path / "sequences", [TINY], "sparse", 2, ray=ray_address, done=counts.append)
    assert counts == [1]
    assert files_of(tmp_path / "frames") == files_of(tmp_path / "alone") == files_of(tmp_path / "sequences")


def test_nothing_is_started_for_no_jobs():
    assert outcomes(square, [], "an address without a cluster") == []


@pytest.mark.long
def test_what_the_caller_raises_stops_all(tmp_path: Path):
    def stop(job: Path, outcome: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_jobs(die_once, [tmp_path / str(k) for k in range(20)], 1, stop)
    assert len(list(tmp_path.iterdir())) < 20


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"ray is not installed: pip install 'sigmaslam\[scale\]'"):
        outcomes(square, [0], "local")


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_worker_ends_with_its_parent(tmp_path: Path):
    """Killed at once, the parent tells it nothing."""
    script = (
        "import sys; from pathlib import Path; from sigmaslam_synthetic.parallel_jobs import run_jobs;"
        "from tests.support.parallel_work import sleep_under_own_number as work;"
        "run_jobs(work, [Path(sys.argv[1])], 1, lambda job, outcome: None)"
    )
    number = tmp_path / "number"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "-c", script, str(number)], env=environment)
    wait_until(number.exists, 60.0)
    parent.kill()
    parent.wait()
    wait_until(lambda: not is_running(int(number.read_text())), 20.0)


def wait_until(done: Callable[[], bool], seconds: float) -> None:
    until = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < until
        time.sleep(0.05)


def is_running(number: int) -> bool:
    """A process that nobody has waited for yet has ended, too."""
    try:
        os.kill(number, 0)
        status = Path(f"/proc/{number}/stat")
        return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}

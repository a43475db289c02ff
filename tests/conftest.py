"""Fixtures that more than one file needs."""

import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

# Comparisons that fail there show their two sides, as those in tests do.
pytest.register_assert_rewrite("tests.support")


# CPU seconds of a test that is not marked `long`; the mark is for those above half of it, and times vary.
_LONGEST_UNMARKED = 1.0


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--part K/N`: of what is selected, every Nth test by name, so that N numbers K one after another run all."""
    parser.addoption("--part", metavar="K/N", help="every Nth of the selected tests by name, from the (K mod N)th on")


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Iterator[None]:
    """Mark the tests that need real data, which `-m data` selects; then choose the part of what is selected."""
    for item in items:
        if "real_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.data)
    yield
    if part := config.getoption("--part"):
        number, count = map(int, part.split("/"))
        chosen = set(sorted(item.nodeid for item in items)[number % count :: count])
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in chosen])
        items[:] = [item for item in items if item.nodeid in chosen]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Notes CPU seconds of the test itself, with those of processes that it started, without its fixtures'."""
    began = _cpu_seconds()
    try:
        yield
    finally:
        item.user_properties.append(("cpu_seconds", _cpu_seconds() - began))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Names tests that took long and are not marked so."""
    for report in terminalreporter.stats.get("passed", []):
        seconds = dict(report.user_properties).get("cpu_seconds", 0.0)
        if seconds > _LONGEST_UNMARKED and not {"long", "slow"} & set(report.keywords):
            terminalreporter.write_line(f"{seconds:.1f} s of CPU, not marked long: {report.nodeid}")


def _cpu_seconds() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Absolute path of the real data sets; tests that need them are skipped where SIGMASLAM_DATA is empty or unset."""
    path = os.environ.get("SIGMASLAM_DATA", "")
    if not path:
        pytest.skip("SIGMASLAM_DATA does not name the folder of the real data sets")
    if not Path(path).is_dir():
        pytest.fail(f"SIGMASLAM_DATA is {path}, which is no folder: correct it, or unset it to skip these tests")
    return Path(path).resolve()


@pytest.fixture(scope="session")
def demo_sequence() -> Path:
    """The rendered sequence that ships with the package."""
    return Path(__file__).resolve().parents[1] / "synthetic" / "sigmaslam_synthetic" / "demo"


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Of torch: small models run best on one thread, and many processes do not get into each other's way."""
    torch = pytest.importorskip("torch")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in this process write no report, which would take longer than to track a few frames."""
    monkeypatch.setattr("sigmaslam.report.report.write_report", lambda run_dir: None)

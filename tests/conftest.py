"""Fixtures that more than one file needs."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# Comparisons that fail there show their two sides, as those in tests do.
pytest.register_assert_rewrite("tests.support")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need real data: `-m data` selects them."""
    for item in items:
        if "real_data" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.data)


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

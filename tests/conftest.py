"""Fixtures that more than one file needs."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real data sets; tests that need it are skipped where there is none."""
    path = os.environ.get("SIGMASLAM_DATA", "")
    if not path or not Path(path).is_dir():
        pytest.skip("SIGMASLAM_DATA is not set")
    return Path(path)


@pytest.fixture(scope="session")
def demo_sequence() -> Path:
    """The rendered sequence that ships with the package."""
    return Path(__file__).resolve().parents[1] / "synthetic" / "demo"

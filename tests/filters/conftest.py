"""Fixtures of the tests of the filters."""

import pytest


@pytest.fixture(autouse=True)
def always_one_thread(one_thread: None) -> None:
    """Each test of the filters."""

"""Fixtures of the tests of the tracker."""

from pathlib import Path

import pytest

from sigmaslam.readers import open_sequence
from sigmaslam.trajectory import read_kitti
from tests.support.estimates import Demo


@pytest.fixture(scope="session")
def demo(demo_sequence: Path) -> Demo:
    """Nobody writes into its images."""
    sequence = open_sequence(demo_sequence)
    return sequence.camera, list(sequence.frames()), read_kitti(demo_sequence / "poses.txt").poses

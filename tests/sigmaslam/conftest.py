"""Fixtures of the tests of the tracker."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam.slam.tracker import Estimate, StereoTracker
from tests.support.estimates import Demo, track


@pytest.fixture(scope="session")
def demo(demo_sequence: Path) -> Demo:
    """Nobody writes into its images."""
    sequence = open_sequence(demo_sequence)
    return sequence.camera, list(sequence.frames()), read_kitti(demo_sequence / "poses.txt").poses


@pytest.fixture(scope="session")
def demo_estimates(demo: Demo) -> Callable[[str], list[Estimate]]:
    """The whole demo, tracked once with each front end."""
    camera, frames, _ = demo
    return cache(lambda frontend: track(StereoTracker(camera, frontend), frames))

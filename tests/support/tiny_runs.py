"""Runs so small that the loop is tested, not the network."""

import functools

import pytest

from sigmaslam_synthetic import homography_pairs
from sigmaslam_training.features import loop
from sigmaslam_training.features.validation import matching_accuracy


def make_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small textures and held-out pairs, of which a run of few steps has one."""
    monkeypatch.setattr(homography_pairs, "_TEXTURE_SIZE", 128)
    monkeypatch.setattr(loop, "matching_accuracy", functools.partial(matching_accuracy, size=96))

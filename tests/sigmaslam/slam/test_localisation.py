"""Which poses a localiser takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.localisation import Localiser

CONFIG = TrackerConfig(min_inliers=15)


@pytest.mark.parametrize(
    ("count", "matches", "nis", "is_taken"),
    [
        (31, 42, 2.1, True),  # the KITTI drive after a dark second
        (18, 37, 2.16, False),  # a street after three: 41 m off, where its texture repeats
        (18, 37, 1.2, True),
        (40, 42, 4.5, False),  # noise
        (60, 200, 3.0, True),  # too many for chance
    ],
)
def test_few_that_fit_badly_are_chance_unless_most_agree(
    monkeypatch: pytest.MonkeyPatch, count: int, matches: int, nis: float, is_taken: bool
):
    found = SimpleNamespace(probability=[1.0] * matches), SimpleNamespace(count=count, nis_before_scaling=nis)
    monkeypatch.setattr(Localiser, "_localise_anywhere", lambda *_: found)
    nothing: Any = None
    localiser = Localiser(*[nothing] * 6, CONFIG, nothing)
    _, fit = localiser.localise(nothing, [], nothing, guided=False, clock=nothing)
    assert (fit is found[1]) == is_taken
    assert is_taken or fit is None

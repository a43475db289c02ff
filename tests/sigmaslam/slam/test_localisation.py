"""Which poses a localiser takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sigmaslam.slam import localisation
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.localisation import Localiser, Prediction

CONFIG = TrackerConfig(min_inliers=15)


@pytest.mark.parametrize(
    ("count", "matches", "nis", "after_gap", "is_taken"),
    [
        (31, 42, 2.1, True, True),  # the KITTI drive after a dark second
        (18, 37, 2.16, False, False),  # a street after three: 41 m off, where its texture repeats
        (18, 37, 1.2, False, True),
        (21, 62, 1.6, True, False),  # another one: 46 m off
        (40, 42, 4.5, False, False),  # noise
        (60, 200, 3.0, True, True),  # too many for chance
    ],
)
def test_few_that_fit_badly_are_chance_unless_most_agree(
    monkeypatch: pytest.MonkeyPatch, count: int, matches: int, nis: float, after_gap: bool, is_taken: bool
):
    found = SimpleNamespace(probability=[1.0] * matches), SimpleNamespace(count=count, nis_before_scaling=nis)
    monkeypatch.setattr(Localiser, "_localise_anywhere", lambda *_: found)
    nothing: Any = None
    clock: Any = SimpleNamespace(after_gap=after_gap)
    localiser = Localiser(*[nothing] * 6, CONFIG, clock)
    _, fit = localiser.localise(nothing, [], nothing, guided=False, clock=nothing)
    assert (fit is found[1]) == is_taken
    assert is_taken or fit is None


@pytest.mark.parametrize(
    ("own", "is_taken"),
    [
        (9, True),  # a street, frames of which a counter did not count: it stayed 1.4 m behind
        (35, False),  # the scene beside a truck
    ],
)
def test_what_agrees_with_both_poses_does_not_speak_for_the_prediction(
    monkeypatch: pytest.MonkeyPatch, own: int, is_taken: bool
):
    """Of 35 landmarks the prediction's pose sees all but `own` where the other pose does, too: they are far."""
    camera = SimpleNamespace(width=400, height=200)

    def found(agree: int, count: int) -> Any:
        places = np.random.default_rng(0).uniform(0, [400, 200, 30], (count, 3))
        views = SimpleNamespace(landmark=np.arange(count), measurement=places)
        fit = SimpleNamespace(inliers=np.arange(count) < agree, nis_per_dof=1.5, pose=np.eye(4))
        return SimpleNamespace(views=views, probability=np.ones(count)), fit

    (matches, alone), (near, rival) = found(67, 81), found(35, 95)
    apart = {81: np.where(np.arange(81) < 40, 20.0, 1.0), 95: np.where(np.arange(95) < own, 20.0, 1.0)}
    monkeypatch.setattr(localisation, "seen_apart", lambda window, rows, *_: apart[len(rows)])
    monkeypatch.setattr(localisation, "surprise", lambda *_: 300.0)
    update: Any = SimpleNamespace(fit=lambda views, *_: alone if views is matches.views else rival)
    window: Any = SimpleNamespace(camera=camera, posterior=SimpleNamespace(poses=np.eye(4)[None]))
    nothing: Any = None
    localiser = Localiser(window, nothing, update, *[nothing] * 3, CONFIG, nothing)
    prediction = Prediction(np.eye(4), np.eye(6))
    assert localiser._fit_alone(matches, near, prediction, np.eye(4), 1.0) is (alone if is_taken else None)


@pytest.mark.parametrize("differs", [False, True])
def test_a_third_of_the_landmarks_is_too_little_after_an_interval_unlike_the_one_before(differs: bool):
    """A street whose stamps take turns by 0.04 and 0.16 s: 67 of 202 agreed on a pose 2 m ahead."""
    followed: Any = SimpleNamespace(turn=None, count=202, differs=differs)
    nothing: Any = None
    localiser = Localiser(nothing, followed, nothing, nothing, followed, nothing, CONFIG, followed)
    fit: Any = SimpleNamespace(nis_per_dof=1.56, count=67)
    assert localiser._is_doubtful(nothing, fit) == differs

"""Optical flow beside a sensor that has measured the turn: whose word counts where the two differ."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sigmaslam.estimation.frame_clock import FrameClock
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.localisation import Localiser, Prediction


@pytest.mark.parametrize(("turn", "interval", "flows"), [(None, 1.0, 1), (np.eye(3), 1.0, 0), (np.eye(3), 0.1, 1)])
def test_after_a_long_while_features_are_found_by_a_sensor_not_flow(turn, interval: float, flows: int):
    followed = []

    def follow(*args):
        followed.append(args)
        return GuidedMatches.empty(), 1.0

    clock = FrameClock()
    clock.tick(interval)
    given: list[Any] = [None, Motion(turn=turn), None, None, SimpleNamespace(follow=follow)]
    localiser = Localiser(*given, None, SimpleNamespace(min_inliers=12), clock)
    prediction = Prediction(np.eye(4), np.eye(6))
    assert localiser.follow(None, [], prediction, SimpleNamespace(lap=lambda name: None))[1] is None
    assert len(followed) == flows


class Motion(SimpleNamespace):
    def widen(self, factor: float) -> None:
        self.widened *= factor


@pytest.mark.parametrize(("found", "widened"), [(300, 4.0), (60, 1.0)])
def test_flow_contradicts_a_sensor_only_where_it_finds_most_landmarks(found: int, widened: float):
    motion = Motion(turn=np.eye(3), widened=4.0)
    update = SimpleNamespace(fit=lambda *args: None)
    follower = SimpleNamespace(count=300)
    config = SimpleNamespace(min_inliers=12)
    given: list[Any] = [SimpleNamespace(), motion, update, None, follower, None, config, FrameClock()]
    localiser = Localiser(*given)
    matches = GuidedMatches.empty()
    object.__setattr__(matches, "searched", np.arange(571))
    fit = SimpleNamespace(pose=se3_exp(np.full(6, 0.1)), count=found, nis_per_dof=1.0)
    assert localiser._confirm(matches, fit, Prediction(np.eye(4), 1e-4 * np.eye(6)), 4.0) is fit
    assert motion.widened == widened

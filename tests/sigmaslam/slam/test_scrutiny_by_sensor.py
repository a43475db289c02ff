"""A sensor of motion tells what moves from the scene, however much of the image it fills."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.slam.scrutiny import Scrutiny

AWAY = se3_exp(np.full(6, 0.05))


@pytest.mark.parametrize(
    ("is_measured", "fit", "second", "is_other"),
    [(True, np.eye(4), AWAY, True), (True, AWAY, np.eye(4), False), (False, np.eye(4), AWAY, False)],
)
def test_of_two_motions_the_one_that_a_sensor_excludes_is_a_movers(is_measured, fit, second, is_other):
    motion: dict[str, Any] = {"is_inertial": is_measured, "is_odometric": False, "reckoning": "inertial"}
    motion |= {"step": np.eye(4), "step_covariance": 1e-6 * np.eye(6)}
    scrutiny = Scrutiny.__new__(Scrutiny)
    scrutiny._motion = SimpleNamespace(**motion)
    scrutiny._window = SimpleNamespace(posterior=SimpleNamespace(poses=[np.eye(4)]))
    assert scrutiny._is_other(SimpleNamespace(pose=second), SimpleNamespace(pose=fit)) == is_other

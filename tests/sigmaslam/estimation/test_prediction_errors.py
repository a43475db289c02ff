"""Poses that depart from their prediction."""

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.prediction_errors import surprise, time_error
from sigmaslam.geometry.se3 import se3_exp

FORWARD = np.array([0.0, 0.0, 2.0, 0.0, 0.1, 0.0])
INTERVAL = 0.1


def driving() -> MotionFilter:
    """Predicted by one interval, with a velocity that is known."""
    motion = MotionFilter()
    motion.set_twist(FORWARD, np.full(6, 0.05))
    motion.predict(INTERVAL, np.array([0.1, 0.01]))
    return motion


def seen(motion: MotionFilter, frames: float, aside: float = 0.0) -> np.ndarray:
    """The pose of an image that is so many frames late, and so many metres aside."""
    return np.asarray(se3_exp(np.array([aside, 0, 0, 0, 0, 0])) @ se3_exp(motion.way(frames * INTERVAL)) @ motion.step)


@pytest.mark.parametrize("frames", [-3.0, -1.0, 1.0, 2.5])
def test_an_image_of_another_time_departs_by_that_many_frames(frames: float):
    motion = driving()
    assert time_error(motion, seen(motion, frames), INTERVAL) == pytest.approx(frames, rel=1e-6)


@pytest.mark.parametrize(("frames", "aside"), [(0.3, 0.0), (0.0, 0.5), (0.6, 0.4)])
def test_a_brake_or_a_step_aside_is_no_wrong_time(frames: float, aside: float):
    motion = driving()
    assert time_error(motion, seen(motion, frames, aside), INTERVAL) == 0.0


def test_noise_aside_does_not_hide_a_wrong_time():
    motion = driving()
    motion.set_twist(0.15 * FORWARD, np.full(6, 0.05))
    aside = 4.0 * np.sqrt(motion.step_covariance[0, 0])
    assert time_error(motion, seen(motion, 1.5, aside), INTERVAL) == pytest.approx(1.5, abs=0.1)
    assert time_error(motion, seen(motion, 1.5, 2.0 * aside), INTERVAL) == 0.0


def test_less_speaks_for_another_time_where_the_driver_is_known_to_exchange_images():
    motion = driving()
    motion.set_twist(0.08 * FORWARD, np.full(6, 0.05))
    late, brake = seen(motion, 1.0), seen(motion, -0.3)
    assert time_error(motion, late, INTERVAL) == 0.0
    assert time_error(motion, late, INTERVAL, expected=True) == pytest.approx(1.0, rel=1e-6)
    assert time_error(motion, brake, INTERVAL, expected=True) == 0.0


def test_a_camera_at_rest_shows_no_time():
    motion = driving()
    motion.set_twist(0.001 * FORWARD, np.full(6, 0.05))
    assert time_error(motion, seen(motion, 100.0), INTERVAL) == 0.0


def test_a_doubted_time_leaves_the_velocity():
    motion, other = driving(), driving()
    step, covariance = seen(motion, 1.0), np.diag(np.full(6, 1e-8))
    other.doubt_time(INTERVAL)
    for each in (motion, other):
        each.correct(step, covariance)
    assert np.linalg.norm(other.twist - FORWARD) < 0.05 * np.linalg.norm(motion.twist - FORWARD)


def test_a_prediction_is_surprised_by_what_it_excludes_and_by_nothing_else():
    motion = driving()
    sigma = np.sqrt(motion.step_covariance[0, 0])
    assert surprise(motion, seen(motion, 0.0, 3.0 * sigma)) == 1.0
    factor = surprise(motion, seen(motion, 0.0, 20.0 * sigma))
    assert factor > 20.0
    motion.widen(factor)
    assert surprise(motion, seen(motion, 0.0, 20.0 * sigma)) == 1.0

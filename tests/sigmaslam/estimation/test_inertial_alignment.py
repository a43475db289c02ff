"""Gravity in a second of poses: found where its length agrees as well as it is known."""

from itertools import pairwise

import numpy as np
import pytest

from sigmaslam.estimation.inertial_alignment import Alignment, _solve, align, has_wrong_sign
from sigmaslam.estimation.preintegration import preintegrate
from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.se3 import se3_exp
from tests.support.inertial import GRAVITY, SENSOR, Motion

TIMES = 0.05 * np.arange(20)


def align_noisy(seed: int, force: float = 1.0) -> tuple[Alignment | None, np.ndarray]:
    """By poses that are off by 2 mm, the sensor's force being scaled, and the true gravity's part in it."""
    rng, motion = np.random.default_rng(seed), Motion(seed, size=0.1)
    exact = motion.measure(np.arange(-0.02, 1.2, 0.005))
    samples = InertialSamples(exact.timestamp, exact.gyro, force * exact.accel)
    sigma = np.repeat([2e-3, 5e-4], 3)
    poses = np.array([se3_exp(sigma * rng.normal(size=6)) @ pose for pose in motion.poses(TIMES)])
    motions = [
        preintegrate(samples, start, end, np.zeros(3), np.zeros(3), SENSOR.spectra, np.zeros(2))
        for start, end in pairwise(TIMES)
    ]
    assert all(motions)
    return align(poses, np.eye(4), motions, np.full(25, 1e-6)), GRAVITY


def test_errors_of_the_sensor_move_gravity_as_the_slope_says():
    motion = Motion(3, size=0.1)
    samples = motion.measure(np.arange(-0.02, 1.2, 0.005))
    motions = [
        preintegrate(samples, *span, np.zeros(3), np.zeros(3), SENSOR.spectra, np.zeros(2)) for span in pairwise(TIMES)
    ]
    bodies, step = motion.poses(TIMES), 1e-4
    slope = _solve(bodies, motions)[3]
    for k in range(19):
        sides = [
            _solve(bodies, [each.corrected(side * step * np.eye(25)[6 + k]) for each in motions])[0]
            for side in (1.0, -1.0)
        ]
        np.testing.assert_allclose(slope[:, k], (sides[0] - sides[1]) / (2 * step), rtol=0.02, atol=2e-3)


@pytest.mark.long
def test_gravity_is_refused_for_its_length_only_where_noise_does_not_explain_it():
    squared = []
    for seed in range(30):
        found, gravity = align_noisy(seed)
        assert found is not None
        error, P = found.gravity - gravity, found.covariance[3:6, 3:6]
        squared.append(error @ np.linalg.pinv(P, 1e-6) @ error / 2)
        assert align_noisy(seed, 1.0 / 9.81)[0] is None  # in g
    assert np.mean(squared) < 1.5


@pytest.mark.parametrize("speed", [1.0, 0.0])
def test_forces_of_the_wrong_sign_are_told_by_the_path(speed: float):
    """They give gravity's length as well; at rest nothing tells them."""
    for seed in range(8):
        rng, motion = np.random.default_rng(seed), Motion(seed, size=0.3 * speed)
        exact = motion.measure(np.arange(-0.02, 1.2, 0.005))
        poses = motion.poses(TIMES)
        poses[:, :3, 3] += rng.normal(0.0, 2e-4, (len(TIMES), 3))
        found = []
        for sign in (1.0, -1.0):
            samples = InertialSamples(exact.timestamp, exact.gyro, sign * exact.accel)
            motions = [
                preintegrate(samples, *span, np.zeros(3), np.zeros(3), SENSOR.spectra, np.zeros(2))
                for span in pairwise(TIMES)
            ]
            found.append(has_wrong_sign(poses, motions))
        assert found == [False, speed > 0.0]

"""A gyro beside a camera on a smooth motion; every frame is predicted, and corrected unless it is dark."""

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.gyro_motion import GyroMotion
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from tests.support.inertial import SENSOR, Motion

FRAME, DENSITIES = 0.05, np.array([0.25, 0.25])
SIGMA = np.repeat([0.002, 0.0005], 3)
MOUNTING = se3_exp(np.array([0.06, -0.02, 0.01, 0.3, -1.2, 0.5]))
BIAS = np.array([-0.003, 0.02, 0.08])


def fly(moves: MotionFilter, frames: int, dark: int, seed: int, sign: float = 1.0) -> tuple[np.ndarray, float]:
    """Error (6,) of the pose since the start after dark frames, and the NEES of its turn per degree of freedom."""
    rng, motion = np.random.default_rng(seed), Motion(seed)
    moves.set_twist(np.zeros(6), np.ones(6))
    samples = motion.measure(np.arange(-0.02, 6.0, 0.005))
    noise = SENSOR.gyro_density / np.sqrt(0.005) * rng.normal(size=samples.gyro.shape)
    rates = sign * samples.gyro + BIAS + noise
    given, errors = 0, np.zeros(6)
    cameras = motion.poses(np.arange(frames + 1) * FRAME) @ se3_inverse(MOUNTING)
    for frame in range(1, frames + 1):
        end = int(np.searchsorted(samples.timestamp, frame * FRAME)) + 1
        for k in range(given, end):
            if "imu" in moves.sensors:
                moves.sensors["imu"].add(samples.timestamp[k], rates[k], np.zeros(3))
        given = end
        moves.predict(FRAME, DENSITIES, timestamp=frame * FRAME)
        truth = se3_inverse(cameras[0]) @ cameras[frame]
        if frame <= frames - dark:
            P, seen = moves.step_covariance, se3_exp(SIGMA * rng.normal(size=6)) @ truth
            gain = P @ np.linalg.inv(P + np.diag(SIGMA**2))
            moves.correct(se3_exp(gain @ se3_log(seen @ se3_inverse(moves.step))) @ moves.step, P - gain @ P)
        errors = se3_log(truth @ se3_inverse(moves.step))
    turn = errors[3:]
    return errors, float(turn @ np.linalg.solve(moves.step_covariance[3:, 3:], turn)) / 3


@pytest.mark.long
def test_turns_are_known_in_the_dark_and_places_as_by_constant_velocity():
    turns, blind, nees = [], [], []
    for seed in range(8):
        moves = GyroMotion("onnx", SENSOR, MOUNTING)
        error, squared = fly(moves, 50, 10, seed)
        assert dead_reckoning(moves) == "inertial"
        assert moves.turn is not None
        turns.append(np.linalg.norm(error[3:]))
        nees.append(squared)
        blind.append(np.linalg.norm(fly(MotionFilter(), 50, 10, seed)[0][3:]))
    assert np.median(turns) < 0.03 * np.median(blind)
    assert np.mean(nees) < 2.0


def test_the_velocity_alone_is_forgotten():
    moves = GyroMotion("onnx", SENSOR, MOUNTING)
    fly(moves, 20, 0, 1)
    rate, spread = moves.twist[3:].copy(), moves.state.covariance[9:, 9:]
    moves.set_twist(np.zeros(6), np.full(6, 7.0))
    np.testing.assert_array_equal(moves.twist, np.r_[np.zeros(3), rate])
    np.testing.assert_array_equal(moves.state.covariance[9:, 9:], spread)
    np.testing.assert_array_equal(moves.state.covariance[6:9, 6:9], 49.0 * np.eye(3))


def test_a_gyro_of_another_sign_is_said_and_not_used(caplog):
    moves = GyroMotion("onnx", SENSOR, MOUNTING)
    fly(moves, 40, 0, 2, sign=-1.0)
    assert not moves.is_odometric
    assert caplog.text.count("the inertial sensor is not used: its turns") == 1

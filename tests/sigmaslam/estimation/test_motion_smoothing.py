"""The backward pass over a constant-velocity chain, against all equations solved at once."""

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.motion_smoothing import MotionLink, smooth_motion
from sigmaslam.geometry.se3 import se3_exp, se3_log

SECONDS, FRAMES = 0.1, 6
# So slow that the motion is linear, and equal numbers must be equal.
DENSITIES = np.array([1e-8, 1e-8])
TWIST_SIGMA, PLACE_SIGMA = 1e-3, 1e-5


def filtered_chain(measured: list[bool], seed: int = 0) -> tuple[list[MotionLink], list[np.ndarray]]:
    """A chain from a keyframe on, and the measured poses (6,) as tangent vectors; a frame without a measurement too."""
    random = np.random.default_rng(seed)
    motion = MotionFilter()
    motion.set_twist(np.zeros(6), np.full(6, TWIST_SIGMA))
    chain = [MotionLink(0.0, motion.state, motion.state)]
    places = []
    for k, is_measured in enumerate(measured, start=1):
        motion.predict(SECONDS, DENSITIES)
        predicted = motion.state
        place = 1e-4 * k * np.ones(6) + PLACE_SIGMA * random.standard_normal(6)
        places.append(place)
        if is_measured:
            P = predicted.covariance[:6, :6]
            gain = P @ np.linalg.inv(P + PLACE_SIGMA**2 * np.eye(6))
            mean = se3_log(motion.step)
            motion.correct(se3_exp(mean + gain @ (place - mean)), P - gain @ P)
        chain.append(MotionLink(k * SECONDS, predicted, motion.state))
    return chain, places


def solved_at_once(measured: list[bool], places: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean (N, 6) and covariance (N, 6, 6) of the poses by one Gaussian over all poses and twists."""
    count, size = len(measured) + 1, 12
    transition = np.eye(size)
    transition[:6, 6:] = SECONDS * np.eye(6)
    q = np.repeat(DENSITIES, 3)
    noise = np.block(
        [
            [np.diag(q * SECONDS**3 / 3), np.diag(q * SECONDS**2 / 2)],
            [np.diag(q * SECONDS**2 / 2), np.diag(q * SECONDS)],
        ]
    )
    # All states as a linear function of the first twist and the noises.
    prior = np.zeros((size, size))
    prior[6:, 6:] = TWIST_SIGMA**2 * np.eye(6)
    joint = np.zeros((count * size, count * size))
    by_source = [np.eye(size)]
    marginal = [prior]
    for _ in range(count - 1):
        marginal.append(transition @ marginal[-1] @ transition.T + noise)
        by_source.append(transition @ by_source[-1])
    for i in range(count):
        for j in range(i, count):
            block = marginal[i] @ np.linalg.matrix_power(transition, j - i).T
            joint[size * i : size * (i + 1), size * j : size * (j + 1)] = block
            joint[size * j : size * (j + 1), size * i : size * (i + 1)] = block.T
    rows = np.concatenate([np.arange(size * k, size * k + 6) for k in range(1, count) if measured[k - 1]])
    values = np.concatenate([place for place, is_measured in zip(places, measured, strict=True) if is_measured])
    gain = joint[:, rows] @ np.linalg.inv(joint[np.ix_(rows, rows)] + PLACE_SIGMA**2 * np.eye(len(rows)))
    mean = (gain @ values).reshape(count, size)[:, :6]
    posterior = joint - gain @ joint[rows]
    spread = np.array([posterior[size * k : size * k + 6, size * k : size * k + 6] for k in range(count)])
    return mean, spread


def test_the_backward_pass_equals_all_equations_at_once():
    measured = [True, True, False, False, True, True]
    chain, places = filtered_chain(measured)
    smoothed = smooth_motion(chain)
    mean, covariance = solved_at_once(measured, places)
    np.testing.assert_allclose(se3_log(smoothed.step), mean, atol=1e-8)
    np.testing.assert_allclose(smoothed.covariance, covariance, atol=1e-3 * PLACE_SIGMA**2)


def test_what_was_not_measured_later_changes_nothing():
    chain, _ = filtered_chain([True, False, False])
    smoothed = smooth_motion(chain)
    np.testing.assert_allclose(smoothed.step, [link.filtered.step for link in chain], atol=1e-12)
    filtered = [link.filtered.covariance[:6, :6] for link in chain]
    np.testing.assert_allclose(smoothed.covariance, filtered, atol=1e-5 * PLACE_SIGMA**2)


def test_no_frames_are_smoothed_to_none():
    assert smooth_motion([]).step.shape == (0, 4, 4)


def test_turns_that_are_hardly_known_are_left_as_they_were_predicted():
    """Frames in the dark before a shaken camera: linear, the pass would swing to and fro and claim less than before."""
    motion = MotionFilter()
    motion.set_twist(np.r_[0.05, 0.0, 0.0, 0.1, 0.05, 0.0], np.full(6, TWIST_SIGMA))
    chain = [MotionLink(0.0, motion.state, motion.state)]
    for k in range(1, 13):
        motion.predict(0.05, np.array([1.0, 4000.0]))
        predicted = motion.state
        if k == 12:
            motion.correct(se3_exp(np.r_[0.03, 0.0, 0.0, 0.1, 0.0, 0.0]), 1e-6 * np.eye(6))
        chain.append(MotionLink(0.05 * k, predicted, motion.state))
    smoothed = smooth_motion(chain)
    for link, step, covariance in zip(chain, smoothed.step, smoothed.covariance, strict=True):
        assert np.trace(covariance) <= 1.001 * np.trace(link.filtered.covariance[:6, :6])
        assert np.linalg.norm(se3_log(step)[3:]) < 0.2

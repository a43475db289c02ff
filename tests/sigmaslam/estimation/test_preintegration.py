import numpy as np
import pytest

from sigmaslam.estimation.inertial_buffer import InertialBuffer
from sigmaslam.estimation.preintegration import Preintegrated, preintegrate
from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.se3 import rotation_log
from tests.support.inertial import GRAVITY, SENSOR, Motion, turned

DENSITIES = np.array([0.25, 0.25])
NONE = np.zeros(3)


def integrate(samples: InertialSamples, start: float, end: float, gyro=NONE, accel=NONE) -> Preintegrated:
    return preintegrate(samples, start, end, gyro, accel, SENSOR.spectra, DENSITIES)


def errors(motion: Motion, found: Preintegrated, start: float) -> np.ndarray:
    """(9,) of turn, velocity and position against the spline."""
    s, t = found.seconds, np.array([start, start + found.seconds])
    R = motion.rotation(t).as_matrix()
    place, speed = motion.place(t), motion.place(t, 1)
    velocity = R[0].T @ (speed[1] - speed[0] - GRAVITY * s)
    position = R[0].T @ (place[1] - place[0] - speed[0] * s - 0.5 * GRAVITY * s * s)
    turn = rotation_log(R[0].T @ R[1] @ found.turn.T)
    return np.r_[turn, velocity - found.velocity, position - found.position]


@pytest.mark.parametrize("seed", range(3))
def test_a_second_of_exact_samples_gives_the_spline_with_the_second_power_of_the_period(seed):
    motion = Motion(seed)
    size = []
    for rate in (200, 1000):
        samples = motion.measure(np.arange(0, 3, 1 / rate))
        size.append(np.abs(errors(motion, integrate(samples, 0.7513, 1.7513), 0.7513)).max())
    assert size[1] < 2e-5
    assert 15 < size[0] / size[1] < 40


def test_two_parts_are_the_whole():
    samples = Motion(1).measure(np.arange(0, 2, 0.005))
    whole, one, two = (integrate(samples, *span) for span in ((0.5, 1.5), (0.5, 1.0), (1.0, 1.5)))
    np.testing.assert_allclose(one.turn @ two.turn, whole.turn, atol=1e-12)
    np.testing.assert_allclose(one.velocity + one.turn @ two.velocity, whole.velocity, atol=1e-12)
    position = one.position + 0.5 * one.velocity + one.turn @ two.position
    np.testing.assert_allclose(position, whole.position, atol=1e-12)


def test_corrections_of_bias_delay_and_factors_are_those_of_integrating_again():
    motion = Motion(2)
    samples = motion.measure(np.arange(0, 2, 0.005))
    first, gyro, accel = integrate(samples, 0.5, 1.0), np.array([0.02, -0.015, 0.01]), np.array([0.1, -0.05, 0.08])
    factors, zero = 5e-3 * np.random.default_rng(5).normal(size=(2, 3, 3)), np.zeros(18)
    scaled = InertialSamples(
        samples.timestamp, samples.gyro - samples.gyro @ factors[0].T, samples.accel - samples.accel @ factors[1].T
    )
    changed = [
        (integrate(samples, 0.5, 1.0, gyro, accel), np.r_[gyro, accel, 0.0, zero]),
        (integrate(samples, 0.5002, 1.0002), np.r_[np.zeros(6), 2e-4, zero]),
        (integrate(scaled, 0.5, 1.0), np.r_[np.zeros(7), factors.ravel()]),
    ]
    for again, change in changed:
        moved = first.slope @ change
        turn = rotation_log(first.turn.T @ again.turn)
        assert np.linalg.norm(turn - moved[:3]) < 0.01 * np.linalg.norm(turn)
        for name, part in (("velocity", slice(3, 6)), ("position", slice(6, 9))):
            difference = getattr(again, name) - getattr(first, name)
            assert np.linalg.norm(difference - moved[part]) < 0.015 * np.linalg.norm(difference), name


@pytest.mark.long
def test_the_covariance_is_that_of_noisy_samples():
    rng, samples = np.random.default_rng(3), Motion(4).measure(np.arange(0, 1.2, 0.005))
    exact, found = integrate(samples, 0.4975, 0.9975), []
    for _ in range(1000):
        gyro, accel = (
            density / np.sqrt(0.005) * rng.normal(size=(len(samples), 3))
            for density in (SENSOR.gyro_density, SENSOR.accel_density)
        )
        noisy = InertialSamples(samples.timestamp, samples.gyro + gyro, samples.accel + accel)
        other = integrate(noisy, 0.4975, 0.9975)
        turn = rotation_log(exact.turn.T @ other.turn)
        found.append(np.r_[turn, other.velocity - exact.velocity, other.position - exact.position])
    expected = exact.gyro_noise + exact.accel_noise
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(np.array(found).T) / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=0.15
    )


def test_a_gap_is_bridged_and_makes_the_motion_less_certain():
    for seed in range(5, 15):
        whole = Motion(seed).measure(np.arange(0, 2, 0.005))
        gap = whole.select((whole.timestamp < 0.8) | (whole.timestamp > 0.9))
        found, exact = integrate(gap, 0.5, 1.0), integrate(whole, 0.5, 1.0)
        assert exact.missing == found.missing == 0.0
        difference = np.r_[rotation_log(exact.turn.T @ found.turn), found.velocity - exact.velocity]
        sigma = np.sqrt(np.diag(found.gyro_noise + found.accel_noise))[:6]
        assert (np.abs(difference) < 4 * sigma).all()
        assert (sigma > 3 * np.sqrt(np.diag(exact.gyro_noise + exact.accel_noise))[:6]).all()


def test_frames_within_a_gap_know_by_how_much_samples_changed_before_it():
    squared = []
    for seed in range(20, 40):
        whole, buffer = Motion(seed).measure(np.arange(0, 3, 0.005)), InertialBuffer(SENSOR)
        gap = whole.select((whole.timestamp < 1.8) | (whole.timestamp > 2.0))
        for sample in zip(gap.timestamp.tolist(), gap.gyro, gap.accel, strict=True):
            buffer.add(*sample)
        # A quarter of it, the ends of which may be alike.
        found, exact = buffer.preintegrate(1.85, 1.9, np.zeros(6), DENSITIES), integrate(whole, 1.85, 1.9)
        sigma = np.sqrt(np.diag(found.gyro_noise + found.accel_noise))[:6]
        squared.append((np.r_[rotation_log(exact.turn.T @ found.turn), found.velocity - exact.velocity] / sigma) ** 2)
    assert np.max(squared) < 4.0**2


def test_a_gap_too_long_to_bridge_is_missing():
    whole = Motion(5).measure(np.arange(0, 2, 0.005))
    gap = whole.select((whole.timestamp < 0.8) | (whole.timestamp > 1.3))
    assert integrate(gap, 0.5, 1.5).missing == pytest.approx(0.51, abs=0.006)


def test_samples_that_end_early_are_held():
    samples = Motion(6).measure(np.arange(0, 1, 0.005))
    assert integrate(samples, 0.9, 1.0).missing == 0.0
    assert integrate(samples, 0.9, 1.1).missing == pytest.approx(0.105, abs=1e-6)


def test_the_turn_of_a_known_rate_is_known():
    t = np.arange(0, 1, 0.01)
    samples = InertialSamples(t, np.tile([0, 0, 1.0], (100, 1)), np.zeros((100, 3)))
    found = integrate(samples, 0.105, 0.605)
    np.testing.assert_allclose(found.turn, turned(np.eye(3), np.array([0, 0, 0.5])), atol=1e-14)
    assert not found.position.any()

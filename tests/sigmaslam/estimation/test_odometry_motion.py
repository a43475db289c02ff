"""Wheels under a camera on a smooth motion; every frame is predicted, and corrected unless it is dark."""

import logging

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.odometry_motion import OdometryMotion
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from tests.support.inertial import Motion

FRAME, PERIOD = 0.05, 0.02
DENSITIES = np.array([0.25, 0.25])
# Of poses, metres and radians.
SIGMA = np.repeat([0.002, 0.0005], 3)
MOUNTING = se3_exp(np.array([0.06, -0.4, 1.0, 0.3, -1.2, 0.5]))


def wheels(motion: Motion, t: np.ndarray) -> np.ndarray:
    """(N, 6) exact twists of the vehicle in its own frame."""
    half = 1e-4
    before, after = motion.poses(t - half), motion.poses(t + half)
    return se3_log(se3_inverse(before) @ after) / (2 * half)


class Drive:
    def __init__(
        self,
        seed: int,
        noise: float = 0.02,
        scale: float = 1.0,
        moves: MotionFilter | None = None,
        motion: Motion | None = None,
    ) -> None:
        self.rng, self.motion = np.random.default_rng(seed), motion or Motion(seed, seconds=8.0)
        self.filter = moves or OdometryMotion("onnx", OdometrySensor(np.eye(4), 0.5, is_planar=False), MOUNTING)
        self.t = np.arange(-0.02, 9.0, PERIOD)
        twists = wheels(self.motion, self.t) * np.r_[np.full(3, scale), np.ones(3)]
        self.twists = twists + noise * self.rng.normal(size=twists.shape)
        self.given, self.frame, self.key = 0, 0, self.camera(0)
        self.filter.set_twist(np.zeros(6), np.ones(6))

    def camera(self, frame: int) -> np.ndarray:
        return np.asarray(self.motion.poses(np.array([frame * FRAME]))[0] @ se3_inverse(MOUNTING))

    @property
    def truth(self) -> np.ndarray:
        """(4, 4) since the keyframe."""
        return np.asarray(se3_inverse(self.key) @ self.camera(self.frame))

    def drive(self, frames: int, dark: bool = False, samples: bool = True) -> None:
        for _ in range(frames):
            self.frame += 1
            t = self.frame * FRAME
            end = int(np.searchsorted(self.t, t)) + 1
            if samples and isinstance(self.filter, OdometryMotion):
                for k in range(self.given, end):
                    self.filter.samples.add(self.t[k] + 0.5, self.twists[k, 3:], self.twists[k, :3])
            self.given = end
            self.filter.predict(FRAME, DENSITIES, timestamp=t)
            if dark:
                continue
            P, seen = self.filter.step_covariance, se3_exp(SIGMA * self.rng.normal(size=6)) @ self.truth
            gain = P @ np.linalg.inv(P + np.diag(SIGMA**2))
            change = gain @ se3_log(seen @ se3_inverse(self.filter.step))
            self.filter.correct(se3_exp(change) @ self.filter.step, P - gain @ P)
            if self.frame % 7 == 0:
                self.key = self.camera(self.frame)
                self.filter.start_keyframe()

    @property
    def error(self) -> np.ndarray:
        return np.asarray(se3_log(self.truth @ se3_inverse(self.filter.step)))

    def nees(self) -> float:
        return float(self.error @ np.linalg.solve(self.filter.step_covariance, self.error)) / 6


def test_wheels_predict_when_they_are_known_to_agree():
    drive = Drive(0)
    drive.drive(9)
    assert not drive.filter.is_odometric
    drive.drive(1)
    assert drive.filter.is_odometric


class Start(Motion):
    """Rests for 1.5 s."""

    def poses(self, t: np.ndarray) -> np.ndarray:
        return super().poses(np.maximum(t - 1.5, 0.0))


@pytest.mark.parametrize(("scale", "is_right"), [(1.0, True), (1.5, False), (3.6, False), (-1.0, False), (1e3, False)])
def test_wheels_in_another_unit_that_began_at_rest_are_left_when_they_turn(
    caplog: pytest.LogCaptureFixture, scale: float, is_right: bool
):
    drive = Drive(3, scale=scale, motion=Start(3, seconds=8.0))
    drive.drive(25)
    assert drive.filter.is_odometric
    drive.drive(35)
    assert drive.filter.is_odometric == is_right
    assert ("the odometry is not used" in caplog.text) == (not is_right)


def test_exact_wheels_are_followed_through_the_dark():
    drive, blind = Drive(1, noise=0.0), Drive(1, moves=MotionFilter())
    for each in (drive, blind):
        each.drive(40)
        each.drive(20, dark=True)
    assert np.linalg.norm(drive.error[:3]) < 0.03
    assert np.linalg.norm(blind.error[:3]) > 0.2


@pytest.mark.long
def test_a_dark_second_stays_within_what_is_claimed():
    nees = []
    for seed in range(24):
        drive = Drive(seed, noise=0.05)
        drive.drive(80)
        drive.drive(20, dark=True)
        nees.append(drive.nees())
    assert 0.3 < np.mean(nees) < 2.0


def test_a_wrong_radius_makes_speed_noisier_and_turns_not():
    right, wrong = Drive(2, noise=0.0), Drive(2, noise=0.0, scale=1.1)
    for each in (right, wrong):
        each.drive(60)
    speed, turn = np.split(wrong.filter.spectrum / right.filter.spectrum, 2)
    assert (speed > 1.5).all()
    np.testing.assert_allclose(turn, 1.0, atol=0.5)


@pytest.mark.parametrize("scale", [3.6, 0.0, -1.0])
def test_another_unit_or_sign_is_said_and_not_used(scale, caplog):
    drive = Drive(3, scale=scale)
    drive.drive(60)
    assert not drive.filter.is_odometric
    assert caplog.text.count("the odometry is not used") == 1
    blind = Drive(3, scale=scale, moves=MotionFilter())
    blind.drive(60)
    np.testing.assert_array_equal(drive.filter.step, blind.filter.step)


def test_wheels_that_begin_to_spin_are_no_longer_followed(caplog):
    drive = Drive(7)
    drive.drive(40)
    drive.twists[drive.given :, :3] *= 5.0
    drive.drive(40)
    assert "the odometry departs from the images" in caplog.text
    assert np.linalg.norm(drive.error[:3]) < 0.02


def test_samples_that_end_leave_constant_velocity(caplog):
    caplog.set_level(logging.INFO)
    drive = Drive(4)
    drive.drive(40)
    drive.drive(5, samples=False)
    assert drive.filter.is_odometric
    drive.drive(20, samples=False)
    assert not drive.filter.is_odometric
    assert "gives no samples" in caplog.text
    drive.drive(15)
    assert drive.filter.is_odometric


def test_a_gap_makes_the_prediction_less_certain():
    whole, gap = Drive(5), Drive(5)
    for each, samples in ((whole, True), (gap, False)):
        each.drive(40)
        each.drive(4, dark=True, samples=samples)
    assert np.trace(gap.filter.step_covariance) > 2 * np.trace(whole.filter.step_covariance)
    assert np.isfinite(gap.nees())


def test_a_loss_leaves_the_velocity_known():
    drive = Drive(6)
    drive.drive(30)
    twist = drive.filter.twist.copy()
    drive.filter.set_twist(np.zeros(6), np.ones(6))
    np.testing.assert_array_equal(drive.filter.twist, twist)

"""Which way is up, with sigmas, from gravity in the keyframe's frame."""

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter, MotionState
from sigmaslam.estimation.inertial_motion import InertialMotion
from sigmaslam.geometry.se3 import rotation_exp, se3_exp
from sigmaslam.slam.inertial_estimate import InertialEstimate, describe_inertial, level_world


class Held(InertialMotion):
    """A motion whose state is given."""

    def __init__(self, step: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> None:
        whole, rows = np.eye(25), np.r_[0:6, 9:18]
        whole[np.ix_(rows, rows)] = covariance
        others = np.r_[np.zeros(3), values, np.zeros(7)]
        self.step, self.is_inertial, self._held = step, True, MotionState(step, others, whole)

    @property
    def state(self) -> MotionState:
        return self._held


def estimate_of(up: np.ndarray) -> InertialEstimate:
    return InertialEstimate(up, 1e-4 * (np.eye(3) - np.outer(up, up)), np.eye(4), *np.zeros((4, 3)))


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.5), (-2.0, -1.2)])
def test_roll_and_pitch_of_a_camera_that_is_turned_by_them(roll: float, pitch: float):
    """The camera is pitched about x first (the view rises), then rolled about its line of sight (right side down)."""
    R = rotation_exp(np.array([pitch, 0.0, 0.0])) @ rotation_exp(np.array([0.0, 0.0, roll]))
    found = estimate_of(R.T @ np.array([0.0, -1.0, 0.0]))
    assert found.roll == pytest.approx(roll, abs=1e-12)
    assert found.pitch == pytest.approx(pitch, abs=1e-12)
    assert found.sigmas[1] == pytest.approx(0.01)
    assert found.sigmas[0] == pytest.approx(0.01 / np.cos(pitch))
    assert found.tilt_sigma == pytest.approx(0.01)


def test_roll_is_open_where_the_camera_looks_down():
    found = estimate_of(np.array([0.0, 0.0, -1.0]))
    assert found.pitch == pytest.approx(-np.pi / 2)
    assert found.sigmas[0] == np.pi


def test_up_and_its_covariance_are_those_of_samples():
    rng = np.random.default_rng(1)
    step, R_rectified_left = se3_exp(rng.normal(size=6)), rotation_exp(np.array([0.02, -0.01, 0.3]))
    values = np.r_[9.80665 * rotation_exp(rng.normal(size=3))[2], 0.1 * rng.normal(size=6)]
    root = 0.01 * rng.normal(size=(15, 15))
    root[6:9] *= 9.8
    covariance = root @ root.T
    found = describe_inertial(Held(step, values, covariance), R_rectified_left, np.eye(4))
    assert found is not None
    errors = rng.normal(size=(100_000, 15)) @ root.T
    turned = rotation_exp(errors[:, 3:6]) @ (step[:3, :3] @ R_rectified_left)
    gravity = values[:3] + errors[:, 6:9]
    up = np.einsum("nji,nj->ni", turned, -gravity / np.linalg.norm(gravity, axis=1, keepdims=True))
    np.testing.assert_allclose(up.mean(axis=0), found.up, atol=5e-3)
    spread = np.cov(up.T)
    np.testing.assert_allclose(found.up_covariance, spread, atol=0.05 * np.linalg.norm(spread))
    np.testing.assert_allclose(found.gyro_bias, values[3:6])
    np.testing.assert_allclose(found.accel_bias_sigma, np.sqrt(np.diag(covariance)[12:]))


def test_the_levelled_world_has_z_up_and_keeps_its_heading():
    rng = np.random.default_rng(2)
    for _ in range(20):
        T_world_camera, up = se3_exp(rng.normal(size=6)), rotation_exp(rng.normal(size=3))[0]
        T = level_world(T_world_camera, up)
        np.testing.assert_allclose(T[:3, :3] @ T_world_camera[:3, :3] @ up, [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    # A level camera: x stays, z (ahead) becomes y, y (down) becomes -z.
    level = level_world(np.eye(4), np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(level[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    for up in ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0]):
        np.testing.assert_allclose(level_world(np.eye(4), np.array(up))[:3, :3] @ up, [0, 0, 1], atol=1e-12)


def test_without_a_sensor_nothing_is_said():
    assert describe_inertial(MotionFilter("onnx"), np.eye(3), np.eye(4)) is None

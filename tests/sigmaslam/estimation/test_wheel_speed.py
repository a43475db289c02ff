import numpy as np
import pytest

from sigmaslam.estimation.odometry_motion import COMPARED
from sigmaslam.estimation.wheel_speed import WheelSpeed
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp

MOUNTING = se3_exp(np.array([0.06, -0.4, 1.0, 0.3, -1.2, 0.5]))
TWIST = np.array([2.0, 0.1, 0.0, 0.0, 0.05, 0.3])
"""Of the vehicle."""
OF_CAMERA = se3_adjoint(MOUNTING) @ TWIST


def drive(scale: float = 1.0, noise: float = 0.0, frames: int = COMPARED) -> WheelSpeed:
    """Wheels at 50 Hz, compared with images at 20 Hz."""
    rng, wheels = np.random.default_rng(0), WheelSpeed(OdometrySensor(np.eye(4), 0.5), MOUNTING)
    for k in range(60):
        wheels.samples.add(0.5 + 0.02 * k, TWIST[3:], scale * TWIST[:3] + noise * rng.normal(size=3))
    for frame in range(frames):
        wheels.compare(0.1 + 0.05 * frame, OF_CAMERA, 0.01)
    return wheels


def test_exact_wheels_say_by_how_much_a_predicted_velocity_is_off():
    wheels, off = drive(), np.array([0.2, -0.1, 0.3])
    found = wheels.measure(0.7, 0.05, OF_CAMERA + np.r_[off, np.zeros(3)])
    assert found is not None
    residual, R, noise = found
    np.testing.assert_allclose(residual, -R @ off, atol=1e-12)
    np.testing.assert_allclose(R, MOUNTING[:3, :3].T)
    np.testing.assert_allclose(noise, 0.0, atol=1e-20)


def test_errors_of_a_second_count_as_one():
    found = drive(noise=0.05).measure(0.7, 0.05, OF_CAMERA)
    assert found is not None
    assert 0.5 < np.trace(found[2]) / (3 * 0.05**2 * 20) < 2.0


@pytest.mark.parametrize("scale", [3.6, -1.0, 0.0])
def test_another_unit_or_sign_is_said_once_and_not_used(scale, caplog):
    wheels = drive(scale, frames=COMPARED + 5)
    assert wheels.measure(0.7, 0.05, OF_CAMERA) is None
    assert caplog.text.count("the odometry is not used") == 1


def test_wheels_are_used_when_they_are_known_and_while_samples_come():
    assert drive(frames=COMPARED - 1).measure(0.7, 0.05, OF_CAMERA) is None
    assert drive().measure(3.0, 0.05, OF_CAMERA) is None

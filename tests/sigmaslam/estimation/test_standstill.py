import numpy as np

from sigmaslam.estimation.standstill import WHILE, Standstill
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.readers.inertial import find_imu, read_imu
from tests.support.inertial import SENSOR

POSE_COVARIANCE = np.diag(np.repeat([0.002, 0.0005], 3) ** 2)
EXPECTED_NOISE = np.square([SENSOR.gyro_density, SENSOR.accel_density])


def samples(seed: int = 0, scale: float = 1.0) -> np.ndarray:
    """Of a resting sensor at 200 Hz, so many times as noisy as its data sheet says."""
    rng, size = np.random.default_rng(seed), np.repeat([SENSOR.gyro_density, SENSOR.accel_density], 3)
    noise = scale * size / np.sqrt(0.005) * rng.normal(size=(100, 6))
    return np.column_stack([np.arange(100) * 0.005, noise + [0.01, -0.02, 0.08, 0.0, 9.8, 0.1]])


def look(still: Standstill, speed: float, felt: np.ndarray, noise: np.ndarray = EXPECTED_NOISE) -> None:
    """Images of a second, of a camera at that speed (m/s)."""
    for t in np.arange(21) * 0.05:
        still.see(float(t), se3_exp(np.array([speed * t, 0, 0, 0, 0, 0])), POSE_COVARIANCE, felt, noise)


def rests(still: Standstill, felt: np.ndarray, speed: float = 0.0, is_dark: bool = False) -> bool:
    return still.holds(felt, np.array([speed, 0.0, 0.0]), 0.02**2 * np.eye(3), is_dark)


def test_rest_needs_images_and_a_quiet_sensor():
    for speed, scale, expected in ((0.0, 1.0, True), (0.1, 1.0, False), (0.0, 8.0, False), (0.1, 8.0, False)):
        still = Standstill(SENSOR)
        look(still, speed, samples(scale=scale))
        assert rests(still, samples(1, scale)) is expected


def test_rest_is_told_by_half_a_second_of_images():
    still = Standstill(SENSOR)
    still.see(0.0, np.eye(4), POSE_COVARIANCE, samples(), EXPECTED_NOISE)
    assert not rests(still, samples())
    still.see(WHILE, np.eye(4), POSE_COVARIANCE, samples(), EXPECTED_NOISE)
    assert rests(still, samples())
    np.testing.assert_allclose(still.speed_variance, 2 * 0.002**2 / WHILE**2 * np.eye(3))


def test_in_the_dark_the_velocity_may_be_zero():
    still = Standstill(SENSOR)
    look(still, 0.5, samples(scale=8.0))
    assert rests(still, samples(), 0.03, is_dark=True)
    assert not rests(still, samples(), 0.2, is_dark=True)
    assert not rests(still, samples(scale=8.0), 0.0, is_dark=True)


def test_a_train_that_the_sensor_does_not_feel_goes_on_in_the_dark():
    still = Standstill(SENSOR)
    look(still, 0.05, samples())
    assert not rests(still, samples(), 0.05, is_dark=True)


def test_idling_engines_are_known_by_what_images_say_of_them():
    still, shaken = Standstill(SENSOR), 25.0 * EXPECTED_NOISE
    assert not rests(still, samples(scale=5.0), is_dark=True)
    look(still, 0.0, samples(scale=5.0), shaken)
    assert rests(still, samples(1, 5.0), is_dark=True)
    np.testing.assert_allclose(still.spectra[:3] / SENSOR.gyro_density**2, 25.0, rtol=0.5)


def test_a_drone_that_hovers_before_still_images_is_not_at_rest():
    still = Standstill(SENSOR)
    look(still, 0.0, samples(scale=30.0), 900.0 * EXPECTED_NOISE)
    assert not rests(still, samples(1, 30.0))
    assert not rests(still, samples(1, 30.0), is_dark=True)


def test_motors_that_start_on_the_ground_end_a_real_rest(real_data):
    recording = read_imu(find_imu(real_data / "euroc_v1_01_static"))
    table = np.column_stack(recording.samples.columns())
    t = table[:, 0] - table[0, 0]
    still, sensor = Standstill(recording.sensor), recording.sensor
    noise = np.square([sensor.gyro_density, sensor.accel_density])
    for time in (0.0, WHILE):
        still.see(time, np.eye(4), POSE_COVARIANCE, table[t < 0.25], noise)
    assert rests(still, table[t < 0.25])
    assert not rests(still, table[t > 0.5])

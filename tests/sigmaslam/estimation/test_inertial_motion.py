import logging

import numpy as np
import pytest

from sigmaslam.estimation.inertial_buffer import InertialBuffer, LearnedNoise, noise_spectra
from sigmaslam.estimation.inertial_motion import InertialMotion
from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam_synthetic.inertial import measure_exactly
from sigmaslam_synthetic.motion.paths import with_stops
from sigmaslam_synthetic.motion.random_motions import FreeSpace, hand_held
from tests.support.inertial import GRAVITY, SENSOR, Halt, Motion

FRAME = 0.05
DENSITIES = np.array([0.25, 0.25])
# Of poses, metres and radians.
SIGMA = np.repeat([0.002, 0.0005], 3)
MOUNTING = se3_exp(np.array([0.06, -0.02, 0.01, 0.3, -1.2, 0.5]))
GYRO_BIAS, ACCEL_BIAS = np.array([-0.003, 0.02, 0.08]), np.array([0.05, -0.1, 0.07])


class Walk(Motion):
    """A walk of renders with a stop in it, as `sigmaslam train render room --motion stops` has it."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.path = with_stops(hand_held(rng, 3.5, FreeSpace((0, 0, 1.5), (2.0, 2.0, 0.4))), rng, 1)

    def poses(self, t: np.ndarray) -> np.ndarray:
        return self.path.poses(t)

    def measure(self, t: np.ndarray) -> InertialSamples:
        return measure_exactly(self.path, np.eye(4), t)[0]


class Flight:
    """A camera with a noisy sensor: every frame is predicted, and corrected unless it is dark."""

    def __init__(self, seed: int, motion: Motion | None = None, noise: float = 5.0, wrong: bool = False) -> None:
        self.rng = np.random.default_rng(seed)
        # Of delay and mounting, by careful calibrations; of scale and misalignment.
        error = wrong * np.repeat([2e-3, 5e-3, 3.5e-3], [1, 3, 3]) * self.rng.normal(size=7)
        self.factors = np.eye(3) + wrong * 5e-3 * self.rng.normal(size=(2, 3, 3))
        believed = se3_exp(error[1:]) @ MOUNTING
        self.motion, self.filter = motion or Motion(seed), InertialMotion("onnx", SENSOR, believed)
        exact = self.motion.measure(np.arange(-0.02, 6.0, 0.005))
        scale = noise / np.sqrt(0.005)
        size = exact.gyro.shape
        self.samples = InertialSamples(
            exact.timestamp + error[0],
            exact.gyro @ self.factors[0].T + GYRO_BIAS + scale * SENSOR.gyro_density * self.rng.normal(size=size),
            exact.accel @ self.factors[1].T + ACCEL_BIAS + scale * SENSOR.accel_density * self.rng.normal(size=size),
        )
        self.given, self.frame, self.key = 0, 0, self.camera(0)
        self.filter.set_twist(np.zeros(6), np.repeat([1.0, 1.0], 3))

    def camera(self, frame: int) -> np.ndarray:
        return np.asarray(self.motion.poses(np.array([frame * FRAME]))[0] @ se3_inverse(MOUNTING))

    @property
    def truth(self) -> np.ndarray:
        """(4, 4) since the keyframe."""
        return np.asarray(se3_inverse(self.key) @ self.camera(self.frame))

    def fly(self, frames: int, dark: bool = False, keyframes: int = 7, samples: bool = True) -> None:
        for _ in range(frames):
            self.frame += 1
            t = self.frame * FRAME
            end = int(np.searchsorted(self.samples.timestamp, t)) + 1
            for k in range(self.given, end) if samples else ():
                self.filter.samples.add(*(column[k] for column in self.samples.columns()))
            self.given = end
            self.filter.predict(FRAME, DENSITIES, timestamp=t)
            if dark:
                continue
            P, seen = self.filter.step_covariance, se3_exp(SIGMA * self.rng.normal(size=6)) @ self.truth
            gain = P @ np.linalg.inv(P + np.diag(SIGMA**2))
            change = gain @ se3_log(seen @ se3_inverse(self.filter.step))
            self.filter.correct(se3_exp(change) @ self.filter.step, P - gain @ P)
            if self.frame % keyframes == 0:
                self.key = self.camera(self.frame)
                self.filter.start_keyframe()

    def nees(self) -> dict[str, float]:
        """Per degree of freedom, of pose, velocity, gravity and biases."""
        state, t = self.filter.state, np.array([self.frame * FRAME])
        R = self.key[:3, :3].T
        velocity, gravity = R @ self.motion.place(t, 1)[0], R @ GRAVITY
        error = np.r_[
            se3_log(self.truth @ se3_inverse(state.step)),
            np.r_[velocity, gravity, GYRO_BIAS, ACCEL_BIAS] - state.twist[:12],
        ]
        # Gravity has its length: only its direction is unknown.
        eye, across = np.eye(18), np.linalg.svd(gravity[None])[2][1:]
        parts = {"pose": eye[:6], "velocity": eye[6:9], "gravity": across @ eye[9:12]}
        parts |= {"gyro": eye[12:15], "accel": eye[15:]}
        P = state.covariance[:18, :18]
        return {
            name: float(part @ error @ np.linalg.pinv(part @ P @ part.T, 1e-9) @ part @ error) / len(part)
            for name, part in parts.items()
        }


def test_gravity_and_biases_are_found_in_a_second():
    flight = Flight(0)
    flight.fly(22)
    assert flight.filter.is_inertial
    flight.fly(58)
    _, gravity, gyro = np.split(flight.filter.state.twist[:9], 3)
    expected = flight.key[:3, :3].T @ GRAVITY
    assert np.degrees(np.arccos(gravity @ expected / np.linalg.norm(gravity) / np.linalg.norm(expected))) < 1.0
    np.testing.assert_allclose(gyro, GYRO_BIAS, atol=0.003)


@pytest.mark.slow
def test_dark_seconds_stay_within_what_is_claimed():
    """A hundred flights, places 0.5 m apart every half second; `pytest -s -m slow -k claimed` prints the figures."""
    errors: dict[float, list[float]] = {0.0: [], 0.5: [], 1.0: [], 2.0: []}
    nees: dict[float, list[dict[str, float]]] = {seconds: [] for seconds in errors}
    within = []
    for seed in range(60_100, 60_200):
        flight = Flight(seed, wrong=True)
        flight.fly(50)
        assert flight.filter.is_inertial
        for seconds in errors:
            flight.fly(50 + round(seconds / FRAME) - flight.frame, dark=True)
            errors[seconds].append(float(np.linalg.norm((flight.truth - flight.filter.step)[:3, 3])))
            nees[seconds].append(flight.nees())
        error = se3_log(flight.truth @ se3_inverse(flight.filter.step))[:3]
        within.append(error @ np.linalg.solve(flight.filter.step_covariance[:3, :3], error) <= 2.5**2)
    for seconds, found in nees.items():
        mean = {name: float(np.mean([each[name] for each in found])) for name in found[0]}
        worst, median = max(errors[seconds]), float(np.median(errors[seconds]))
        print(f"{seconds:g} s: median {median:.3f} m, worst {worst:.3f} m, NEES {mean}")
        assert all(0.7 < each < 1.4 for each in mean.values()), mean
        if seconds == 1.0:
            assert median < 0.04
            assert worst < 0.1
    print(f"after 2 s {np.mean(within):.0%} within 2.5 sigma")
    # Of right covariances 90 % are, of a hundred flights 81 to 99 %.
    assert np.mean(within) > 0.81


def test_images_that_are_better_than_they_claim_do_not_make_the_sensor_certain():
    buffer, noise = InertialBuffer(SENSOR), LearnedNoise()
    for column in zip(*Motion(0).measure(np.arange(0.0, 0.1, 0.005)).columns(), strict=True):
        buffer.add(*column)
    motion = buffer.preintegrate(0.02, 0.07, np.zeros(6), DENSITIES)
    before = noise.of(motion)
    for _ in range(200):
        noise.learn(np.zeros(6), np.eye(6))
    assert noise.scale.max() < 2.0
    np.testing.assert_array_equal(noise.of(motion), before)
    for _ in range(200):
        noise.learn(np.full(6, 3.0), np.eye(6))
    assert (np.diag(noise.of(motion)) > np.diag(before)).all()


def test_noise_is_what_successive_samples_do_not_share():
    """At least the data sheet's; a swing of 1 Hz and a gap add nothing."""
    t, rng = np.arange(0.0, 1.0, 0.005), np.random.default_rng(0)
    sheet = SENSOR.spectra
    swing = np.sin(2.0 * np.pi * t)[:, None] * [0.5, 0.0, -0.5, 1.0, 2.0, 0.0]
    for scale, expected in ((0.0, 1.0), (1.0, 1.0), (10.0, 100.0)):
        white = scale * np.repeat(np.sqrt(sheet / 0.005), 3) * rng.normal(size=(len(t), 6))
        samples = np.column_stack([t, swing + white])
        for table in (samples, np.delete(samples, range(80, 120), axis=0)):
            np.testing.assert_allclose(noise_spectra(table, sheet) / sheet, expected, rtol=0.25)
    np.testing.assert_array_equal(noise_spectra(samples[:2], sheet), 25.0 * sheet)


def test_an_idling_engine_is_at_rest():
    """Its tones are no noise of the sensor."""
    flight = Flight(1, Motion(1, size=0.0), noise=1.0)
    t, gyro, accel = flight.samples.columns()
    tone = np.sin(2.0 * np.pi * 13.0 * t)[:, None] * [1.0, -0.5, 0.5]
    flight.samples = InertialSamples(t, gyro + 0.005 * tone, accel + 0.15 * tone)
    for dark in (False, True):
        flight.fly(40, dark=dark)
        assert flight.filter.is_resting
    assert np.linalg.norm(flight.filter.step[:3, 3]) < 0.01


def test_at_rest_gravity_is_found_as_well():
    flight = Flight(1, Motion(1, size=0.0))
    flight.fly(40)
    assert flight.filter.is_inertial
    flight.fly(20, dark=True)
    assert np.linalg.norm(flight.filter.step[:3, 3]) < 0.03
    assert flight.nees()["pose"] < 3


@pytest.mark.long
def test_a_body_that_stops_stays_where_it_is_in_the_dark():
    for seed in range(3):
        flight = Flight(seed, Halt(seed), noise=1.0, wrong=True)
        flight.fly(44)
        assert flight.filter.is_inertial
        assert not flight.filter.is_resting
        flight.fly(60, dark=True)
        assert flight.filter.is_resting
        # Without that it is 0.2 m off.
        assert np.linalg.norm((flight.truth - flight.filter.step)[:3, 3]) < 0.01
        assert flight.nees()["pose"] < 2.0
        assert flight.nees()["gyro"] < 3.0


@pytest.mark.long
def test_rests_of_walks_are_found_and_few_slow_frames_besides():
    found, wrong = [], []
    for seed in range(4):
        walk, still = Walk(seed), 0
        flight = Flight(seed, walk, noise=1.0, wrong=True)
        for frame in range(110):
            flight.fly(1)
            speed = walk.path.motion(np.array([flight.frame * FRAME])).velocity[0]
            still = 0 if np.linalg.norm(speed) > 1e-6 else still + 1
            if still > 13 and frame > 40:  # half a second of images, and gravity is known
                found.append(flight.filter.is_resting)
            elif not still and flight.filter.is_resting:
                wrong.append(np.linalg.norm(speed))
    print(f"{np.mean(found):.2f} of {len(found)} found, {len(wrong)} wrong, at up to {max(wrong):.3f} m/s")
    assert np.mean(found) > 0.6
    assert len(wrong) <= 4 * 12
    assert max(wrong) < 0.1


def test_without_samples_it_is_constant_velocity():
    from sigmaslam.estimation.constant_velocity import MotionFilter

    flight, other = Flight(2), MotionFilter()
    other.set_twist(np.zeros(6), np.repeat([1.0, 1.0], 3))
    for _ in range(30):
        flight.fly(1, keyframes=1000, samples=False)
        other.predict(FRAME, DENSITIES)
        state = flight.filter.state
        other.correct(state.step, state.covariance[:6, :6])
    assert not flight.filter.is_inertial
    np.testing.assert_allclose(flight.filter.twist, other.twist, atol=1e-12)


def test_a_sensor_that_dies_leaves_constant_velocity(caplog):
    flight = Flight(3)
    flight.fly(40)
    with caplog.at_level(logging.WARNING):
        flight.fly(30, samples=False)
    assert not flight.filter.is_inertial
    assert caplog.text.count("gives no samples") == 1
    assert np.linalg.norm((flight.truth - flight.filter.step)[:3, 3]) < 0.02


def test_late_samples_are_left_out_and_said_once(caplog):
    flight = Flight(4)
    flight.fly(10)
    for _ in range(3):
        flight.filter.samples.add(0.1, np.zeros(3), np.zeros(3))
    assert (np.diff(flight.filter.samples.around(0.0, 1.0)[:, 0]) > 0.0).all()
    assert caplog.text.count("not later than the last one") == 1


@pytest.mark.long
def test_a_blow_is_said_and_leaves_the_mounting_less_certain(caplog):
    flights = [Flight(3), Flight(3)]
    for flight in flights:
        flight.fly(40)
    hit = int(np.searchsorted(flights[0].samples.timestamp, flights[0].frame * FRAME + 0.02))
    flights[0].samples.accel[hit] += 30.0
    with caplog.at_level(logging.WARNING):
        for flight in flights:
            flight.fly(1)
    assert caplog.text.count("felt a blow at") == 1
    hurt, well = (np.sqrt(np.diag(flight.filter.state.covariance)[37:43]) for flight in flights)
    assert (hurt > 1.2 * well).all()


def test_images_widen_pose_and_velocity_alone_and_can_be_taken_back():
    flight = Flight(5)
    flight.fly(40)
    before = flight.filter.state.covariance
    flight.filter.widen(9.0)
    wide = flight.filter.state.covariance
    np.testing.assert_allclose(wide[:9, :9], 9 * before[:9, :9])
    np.testing.assert_array_equal(wide[9:, 9:], before[9:, 9:])
    flight.filter.widen(1.0 / flight.filter.widened)
    np.testing.assert_allclose(flight.filter.state.covariance, before, rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(
    "fault",
    [
        np.degrees,
        lambda gyro: -gyro,
        lambda gyro: gyro[:, [1, 2, 0]],
        lambda gyro: gyro * [1, -1, -1],
        lambda gyro: 0.0 * gyro,
    ],
    ids=["degrees", "signs", "axes", "turned by 180 degrees", "dead"],
)
def test_a_gyro_of_another_unit_or_axis_is_said_once_and_not_used(fault, caplog):
    flight = Flight(6)
    flight.samples = InertialSamples(flight.samples.timestamp, fault(flight.samples.gyro), flight.samples.accel)
    flight.fly(60)
    assert not flight.filter.is_inertial
    assert caplog.text.count("are unit (rad/s), axes") == 1
    assert np.linalg.norm((flight.truth - flight.filter.step)[:3, 3]) < 0.01


def changed(samples: InertialSamples, since: float, until: float, fault) -> InertialSamples:
    """Samples with a fault, which takes and gives times, rates and forces, between two times."""
    on = (samples.timestamp >= since) & (samples.timestamp < until)
    columns = [column.copy() for column in samples.columns()]
    for column, values in zip(columns, fault(*(column[on] for column in columns)), strict=True):
        column[on] = values
    return InertialSamples(*columns)


@pytest.mark.long
@pytest.mark.parametrize(
    "fault",
    [
        lambda t, gyro, accel: (t + 0.1, gyro, accel),
        lambda t, gyro, accel: (t, gyro[:, [1, 2, 0]], accel),
        lambda t, gyro, accel: (t, gyro, accel / 9.81),
        lambda t, gyro, accel: (t, gyro, accel[:, [1, 2, 0]]),
        lambda t, gyro, accel: (t, 0.0 * gyro + gyro[0], 0.0 * accel + accel[0]),
    ],
    ids=["clock", "axes of the gyro", "unit of the force", "axes of the force", "stuck"],
)
def test_a_sensor_that_turns_wrong_is_said_and_left_within_a_second(fault, caplog):
    flight = Flight(5, wrong=True)
    flight.samples = changed(flight.samples, 2.5, 9.0, fault)
    flight.fly(70)
    assert not flight.filter.is_inertial
    assert caplog.text.count("images contradict the inertial sensor") == 1
    # By the sensor a dark second would end 0.8 to 13 m off at a sigma of 0.1 m.
    flight.fly(20, dark=True)
    error = se3_log(flight.truth @ se3_inverse(flight.filter.step))
    assert error @ np.linalg.solve(flight.filter.step_covariance, error) / 6 < 20.0


@pytest.mark.long
def test_a_sensor_that_is_wrong_for_a_moment_is_used_again():
    flight = Flight(5)
    flight.samples = changed(flight.samples, 2.0, 3.0, lambda t, gyro, accel: (t, -gyro, accel))
    flight.fly(52)
    assert not flight.filter.is_inertial
    flight.fly(38)
    assert flight.filter.is_inertial
    flight.fly(20, dark=True)
    assert np.linalg.norm((flight.truth - flight.filter.step)[:3, 3]) < 0.1
    assert flight.nees()["pose"] < 3.0


@pytest.mark.long
@pytest.mark.parametrize(("unit", "late", "cause"), [(9.81, 0.0, "are unit (m/s^2)"), (1.0, 0.2, "are missing")])
def test_a_sensor_that_cannot_be_used_is_said_once(unit, late, cause, caplog):
    flight = Flight(5)
    t, gyro, accel = flight.samples.columns()
    flight.samples, flight.filter.samples.time_shift = InertialSamples(t + late, gyro, accel / unit), late
    flight.fly(100)
    assert not flight.filter.is_inertial
    assert caplog.text.count("not used yet") == caplog.text.count(cause) == 1

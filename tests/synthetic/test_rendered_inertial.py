"""A rendered inertial sensor: against its spline, its noise against what it is asked for, and through the reader."""

import numpy as np
import pytest
import yaml

from sigmaslam.errors import InputError
from sigmaslam.estimation.preintegration import preintegrate
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.se3 import rotation_exp, rotation_log, se3_inverse
from sigmaslam.readers.inertial import find_imu, read_imu
from sigmaslam_synthetic.camera.rig import parallel_rig
from sigmaslam_synthetic.inertial import GRAVITY, InertialGrade, measure_exactly, simulate_inertial, wander
from sigmaslam_synthetic.layouts import write_inertial
from sigmaslam_synthetic.motion.paths import Path, Stop, at_rest
from sigmaslam_synthetic.motion.random_motions import FreeSpace, hand_held
from sigmaslam_synthetic.presets import SENSORS, Layout
from sigmaslam_synthetic.simulation import Recipe, Simulation, inertial_of
from tests.support.small_worlds import CAMERA, small_scene

MOUNTING = np.eye(4)
MOUNTING[:3, :3] = rotation_exp(np.array([0.4, -1.2, 2.0]))
MOUNTING[:3, 3] = [0.05, -0.03, 0.08]


@pytest.fixture(scope="module")
def walk() -> Path:
    return hand_held(np.random.default_rng(3), 12.0, FreeSpace((0, 0, 1.5), (1.5, 1.5, 0.3)))


@pytest.fixture(scope="module")
def stopping() -> Path:
    """Random knots half a second apart, with two rests."""
    rng, times = np.random.default_rng(0), np.arange(0.0, 10.5, 0.5)
    knots = 0.3 * rng.normal(size=(2, len(times), 3))
    return Path(times, knots[0], knots[1], (Stop(2.2, 1.0, 0.8), Stop(6.1, 0.4, 1.1)))


def small_simulation(layout: Layout) -> Simulation:
    frames, path = 10, hand_held(np.random.default_rng(7), 1.0, FreeSpace((0, 0, 1.5), (1.5, 1.5, 0.3)))
    rig = parallel_rig(CAMERA, 0.1)
    return Simulation(small_scene(), path, rig, 20.0, frames, layout, SENSORS["ideal"], np.ones((frames, 2)), 0)


def differences(path: Path, t: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rate, velocity and specific force of the mounted sensor by central differences of its poses."""
    before, now, after = (path.poses(t + step) @ MOUNTING for step in (-h, 0.0, h))
    rate = rotation_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * h)
    velocity = (after - before)[:, :3, 3] / (2 * h)
    acceleration = (after - 2 * now + before)[:, :3, 3] / h**2
    return rate, velocity, np.einsum("nji,nj->ni", now[:, :3, :3], acceleration - GRAVITY)


@pytest.mark.parametrize("name", ["walk", "stopping"])
def test_exact_values_are_the_derivatives_of_the_poses_lever_arm_and_stops_included(name, request):
    path = request.getfixturevalue(name)
    t = np.linspace(0.05, path.end - 0.05, 301)
    samples, velocity = measure_exactly(path, MOUNTING, t)
    for found, expected, tolerance in zip(
        (samples.gyro, velocity, samples.accel), differences(path, t, 1e-4), (1e-5, 1e-5, 5e-3), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=tolerance)


def test_at_rest_gravity_alone_is_measured(stopping):
    t = np.linspace(2.65, 3.55, 20)  # the speed falls until 2.2 + 0.4 s, and rises from 3.6 s on
    for path, times in ((stopping, t), (at_rest(MOUNTING, 1.0), t), (stopping, np.array([99.0]))):
        samples, velocity = measure_exactly(path, MOUNTING, times)
        assert np.abs(samples.gyro).max() < 1e-12
        assert np.abs(velocity).max() < 1e-12
        up = (path.poses(times) @ MOUNTING)[:, 2, :3]
        np.testing.assert_allclose(samples.accel, -GRAVITY[2] * up, atol=1e-10)


def test_integrated_samples_are_the_splines_motion_with_the_second_power_of_the_period(walk):
    start, end, size = 2.013, 3.013, []
    sensor = InertialSensor(MOUNTING, 1.0, 1.0, 1.0, 1.0)
    (_, speed), T = (
        measure_exactly(walk, MOUNTING, np.array([start, end])),
        walk.poses(np.array([start, end])) @ MOUNTING,
    )
    R, place, s = T[:, :3, :3], T[:, :3, 3], end - start
    for rate in (100, 200, 400, 800):
        samples, _ = measure_exactly(walk, MOUNTING, np.arange(1.9, 3.2, 1 / rate))
        found = preintegrate(samples, start, end, np.zeros(3), np.zeros(3), sensor.spectra, np.ones(2))
        position = R[0].T @ (place[1] - place[0] - speed[0] * s - 0.5 * GRAVITY * s * s)
        velocity = R[0].T @ (speed[1] - speed[0] - GRAVITY * s)
        turn = rotation_log(R[0].T @ R[1] @ found.turn.T)
        size.append(np.linalg.norm(np.r_[turn, velocity - found.velocity, position - found.position]))
    orders = np.log2(np.array(size[:-1]) / size[1:])
    assert 1.6 < orders.mean() < 2.4
    assert size[-1] < 2e-4


def allan_deviation(values: np.ndarray, count: int) -> float:
    """Overlapping, over axes, of means of so many samples (IEEE Std 952-1997, annex C)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = (total[count:] - total[:-count]) / count
    return float(np.sqrt(0.5 * np.mean((means[count:] - means[:-count]) ** 2)))


@pytest.mark.long
def test_allan_deviation_has_the_densities_and_slopes_that_are_asked_for():
    rate, duration = 100.0, 4000.0
    grade = InertialGrade(2e-3, 1e-2, 3e-4, 2e-3, 0, 0, 0, 0, delay=0, place=0, turn=0)
    found = simulate_inertial(at_rest(np.eye(4), 1.0), duration, rate, np.random.default_rng(1), np.eye(4), grade)
    for values, density, walk in (
        (found.samples.gyro, grade.gyro_density, grade.gyro_walk),
        (found.samples.accel, grade.accel_density, grade.accel_walk),
    ):
        short, long = 0.1, 200.0
        for tau in (short, 4 * short):  # slope -1/2
            assert allan_deviation(values, round(tau * rate)) == pytest.approx(density / np.sqrt(tau), rel=0.03)
        for tau in (long / 4, long):  # slope 1/2
            expected = np.hypot(walk * np.sqrt(tau / 3), density / np.sqrt(tau))
            assert allan_deviation(values, round(tau * rate)) == pytest.approx(expected, rel=0.3)


def test_biases_begin_and_wander_as_they_are_asked_to():
    drift = np.stack([wander(np.random.default_rng(k), 101, 0.01, 0.5, 0.2) for k in range(2000)])
    assert drift[:, 0].std() == pytest.approx(0.5, rel=0.05)
    assert (drift[:, -1] - drift[:, 0]).std() == pytest.approx(0.2, rel=0.05)


def test_scale_misalignment_bias_and_saturation_are_what_the_truth_says(walk):
    grade = InertialGrade(0, 0, scale=0.05, misalignment=0.05, accel_range=5.0)
    found = simulate_inertial(walk, 10.0, 200.0, np.random.default_rng(2), np.eye(4), grade)
    samples, truth = found.samples, found.truth
    np.testing.assert_allclose(samples.gyro, truth.gyro @ truth.gyro_matrix.T + truth.gyro_bias, atol=1e-12)
    whole = truth.accel @ truth.accel_matrix.T + truth.accel_bias
    np.testing.assert_allclose(samples.accel, np.clip(whole, -5.0, 5.0), atol=1e-12)
    assert (np.abs(samples.accel) == 5.0).any()
    assert 0.01 < np.abs(truth.gyro_matrix - np.eye(3)).max() < 0.2


def test_delay_and_mounting_are_those_of_the_truth_and_the_files_are_off_by_the_grade(walk):
    rngs, blind = (np.random.default_rng(k) for k in range(300)), InertialGrade(0, 0)
    found = [simulate_inertial(walk, 0.1, 200.0, rng, np.eye(4), blind) for rng in rngs]
    truth = found[0].truth
    again, velocity = measure_exactly(walk, truth.T_left_imu, np.maximum(truth.timestamp - truth.time_shift, 0.0))
    np.testing.assert_allclose(again.gyro, truth.gyro, atol=1e-12)
    np.testing.assert_allclose(again.accel, truth.accel, atol=1e-12)
    np.testing.assert_allclose(velocity, truth.velocity, atol=1e-12)
    error = np.array([se3_inverse(each.sensor.T_left_imu) @ each.truth.T_left_imu for each in found])
    grade = InertialGrade()
    assert error[:, :3, 3].std() == pytest.approx(grade.place, rel=0.1)
    assert rotation_log(error[:, :3, :3]).std() == pytest.approx(grade.turn, rel=0.1)
    assert np.std([float(each.truth.time_shift) for each in found]) == pytest.approx(grade.delay, rel=0.15)


@pytest.mark.parametrize("layout", ["kitti", "euroc"])
def test_files_are_found_and_read_back(layout, tmp_path):
    simulation = small_simulation(layout)
    recipe = Recipe("room", simulation.frames, seed=4, imu=100.0)
    made = inertial_of(recipe, simulation)
    (tmp_path / "mav0" / "cam0").mkdir(parents=True)
    identity = {"T_BS": {"cols": 4, "rows": 4, "data": np.eye(4).ravel().tolist()}}
    (tmp_path / "mav0" / "cam0" / "sensor.yaml").write_text(yaml.safe_dump(identity))
    write_inertial(tmp_path, simulation, made)
    table = find_imu(tmp_path)
    assert table is not None
    read = read_imu(table)
    assert read.dropped == 0
    np.testing.assert_allclose(read.samples.gyro, made.samples.gyro, atol=1e-9)
    np.testing.assert_allclose(read.samples.accel, made.samples.accel, atol=1e-9)
    np.testing.assert_allclose(read.sensor.T_left_imu, made.sensor.T_left_imu, atol=1e-12)
    assert read.sensor.gyro_walk == made.sensor.gyro_walk
    assert read.sensor.accel_density == made.sensor.accel_density
    first = 0.0 if layout == "kitti" else 1.6e9
    assert read.samples.timestamp[0] < first
    assert read.samples.timestamp[-1] > first + simulation.times[-1]
    with np.load(table.with_name("truth.npz")) as truth:
        np.testing.assert_allclose(truth["timestamp"], read.samples.timestamp, atol=1e-6)
        assert float(truth["time_shift"]) == float(made.truth.time_shift)
        assert np.linalg.norm(truth["gravity"]) == pytest.approx(9.80665)
        poses = simulation.path.poses(simulation.times)
        down = poses[0, 2, :3] if layout == "kitti" else np.array([0, 0, 1.0])
        np.testing.assert_allclose(truth["gravity"], -9.80665 * down, atol=1e-9)


def test_a_seed_is_one_sensor_and_another_seed_is_another():
    simulation = small_simulation("kitti")
    one, again, other = (inertial_of(Recipe("room", 4, seed=k, imu=100.0), simulation) for k in (1, 1, 2))
    np.testing.assert_array_equal(one.samples.gyro, again.samples.gyro)
    assert not np.allclose(one.samples.accel[:5], other.samples.accel[:5])


def test_a_rate_out_of_range_is_refused():
    with pytest.raises(InputError, match="samples a second"):
        Recipe("room", 2, imu=1.0).check()

"""Delay, rotation and lever arm of an inertial sensor, found by a camera's path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.calibration.arrow_solver import ArrowSystem, Factor
from sigmaslam.calibration.calibrate import calibrate
from sigmaslam.calibration.imu_calibration import CameraPath, ImuCalibration, _inertial, _State, calibrate_imu
from sigmaslam.calibration.imu_report import board_path, describe_imu_calibration, write_imu_calibration
from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.errors import CalibrationError
from sigmaslam.estimation.preintegration import preintegrate
from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor
from sigmaslam.geometry.se3 import rotation_log, se3_exp, se3_inverse
from sigmaslam.readers.inertial import find_imu, read_imu
from sigmaslam.runs.calibrate_imu import calibrate_imu_by_run
from tests.support.commands import assert_refused, run_here
from tests.support.inertial import SENSOR, Motion
from tests.support.simulated_board import CHESSBOARD, seen_corners, stereo_rig, views_of

RATE = 200.0


@dataclass(frozen=True)
class Recorded:
    """A sensor that measures a motion, and what is true of it."""

    samples: InertialSamples
    sensor: InertialSensor
    motion: Motion
    biases: np.ndarray

    def error(self, found: ImuCalibration) -> np.ndarray:
        """(7,) of the calibration."""
        T, true = found.sensor.T_left_imu, self.sensor.T_left_imu
        turned = rotation_log(true[:3, :3].T @ T[:3, :3])
        return np.r_[found.sensor.time_shift - self.sensor.time_shift, turned, T[:3, 3] - true[:3, 3]]


def record(seed: int, seconds: float, size: float = 0.3) -> Recorded:
    """With the noise of the densities, walking biases, a delay of 20 ms either way and a lever arm of some 5 cm."""
    rng = np.random.default_rng(seed + 1000)
    motion, h = Motion(seed, seconds, size), 1.0 / RATE
    t = np.arange(-0.5, seconds + 0.5, h)
    true, biases = motion.measure(t), []
    for size_0, walk in ((0.03, SENSOR.gyro_walk), (0.1, SENSOR.accel_walk)):
        steps = walk * np.sqrt(h) * rng.normal(size=(len(t), 3))
        biases.append(size_0 * rng.normal(size=3) + np.cumsum(steps, axis=0))
    gyro, accel = (
        values + bias + density / np.sqrt(h) * rng.normal(size=values.shape)
        for values, bias, density in (
            (true.gyro, biases[0], SENSOR.gyro_density),
            (true.accel, biases[1], SENSOR.accel_density),
        )
    )
    mounting = se3_exp(np.r_[0.05 * rng.normal(size=3) + [0.05, 0, 0], rng.normal(size=3)])
    delay = float(rng.choice([-0.02, 0.02]))
    return Recorded(
        InertialSamples(t + delay, gyro, accel),
        replace(SENSOR, T_left_imu=mounting, time_shift=delay),
        motion,
        np.concatenate([each[np.searchsorted(t, seconds - 0.05)] for each in biases]),
    )


def calibrated(recorded: Recorded, seed: int, seconds: float) -> ImuCalibration:
    """By poses of 20 images a second with independent errors, from no mounting and no delay."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 0.05)
    covariance = np.diag([4e-4, 4e-4, 1e-3, 1e-3, 1e-3, 3e-4]) ** 2
    errors = se3_exp(rng.multivariate_normal(np.zeros(6), covariance, len(times)))
    poses = se3_exp(rng.normal(size=6)) @ recorded.motion.poses(times) @ se3_inverse(recorded.sensor.T_left_imu)
    start = replace(recorded.sensor, T_left_imu=np.eye(4), time_shift=0.0)
    spread = np.tile(covariance, (len(times), 1, 1))
    path = CameraPath(times, poses @ errors, spread, np.zeros((len(times), 6, 0)))
    return calibrate_imu(path, recorded.samples, start)


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


@pytest.mark.long
def test_a_delay_of_20_ms_and_a_lever_arm_are_found_from_nothing():
    recorded = record(3, 4.0)
    found = calibrated(recorded, 3, 4.0)
    error, sigmas = recorded.error(found), np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(error) < 3.0 * sigmas)
    assert sigmas[0] < 1e-4
    assert np.all(sigmas[4:] < 2e-3)
    np.testing.assert_allclose(found.scales, 1.0, atol=0.6)
    assert "timeshift_cam_imu" in describe_imu_calibration(found)


@pytest.mark.slow
def test_errors_of_twenty_calibrations_are_as_large_as_claimed():
    errors, of_biases, within = [], [], []
    for seed in range(20):
        recorded = record(seed, 8.0)
        found = calibrated(recorded, seed, 8.0)
        error = recorded.error(found)
        errors.append(nees(error, found.covariance))
        of_biases.append(nees(found.biases - recorded.biases, found.bias_covariance))
        within.append(np.abs(error) < 3.0 * np.sqrt(np.diag(found.covariance)))
    # Of 140 degrees of freedom chi-square over them is 0.77 to 1.25 in 95 %.
    assert 0.7 < np.mean(errors) < 1.4
    assert 0.7 < np.mean(of_biases) < 1.4
    assert np.mean(within) > 0.985


@pytest.mark.long
def test_a_board_before_a_moved_rig_calibrates_both(tmp_path: Path):
    recorded, rig, rng = record(8, 4.0, size=0.07), stereo_rig(), np.random.default_rng(1)
    times = np.arange(0.0, 4.0, 0.1)
    in_front = np.eye(4)
    in_front[:3, 3] = [-0.1, -0.06, 0.55]
    path = recorded.motion.poses(times) @ se3_inverse(recorded.sensor.T_left_imu)
    T_left_board = se3_inverse(path) @ (path[0] @ in_front)
    corners = seen_corners(rig, CHESSBOARD, T_left_board)
    corners = replace(corners, pixels=corners.pixels + 0.1 * rng.normal(size=corners.pixels.shape))
    stamps = [f"{1_700_000_000_000_000_000 + round(1e9 * t)}.png" for t in times]
    eyes = [(eye.width, eye.height) for eye in rig.eyes]
    result = calibrate(stamps, views_of(rig, CHESSBOARD, corners), CHESSBOARD.points, eyes, "radtan5")
    later = replace(recorded.samples, timestamp=recorded.samples.timestamp + 1_700_000_000)
    found = calibrate_imu(board_path(result), later, replace(SENSOR, T_left_imu=np.eye(4)))
    error, sigmas = recorded.error(found), np.sqrt(np.diag(found.covariance))
    # Time stamps of this size have a resolution of 0.2 us.
    assert np.all(np.abs(error) < 3.5 * sigmas)
    assert np.all(sigmas[4:] < 5e-3)

    table = tmp_path / "imu0" / "data.csv"
    table.parent.mkdir()
    rows = np.column_stack([later.timestamp, later.gyro, later.accel])
    np.savetxt(table, rows, delimiter=",", fmt="%.9f")
    (tmp_path / "imu0" / "imu.yaml").write_text(
        "".join(
            f"{kind}_{what}: {value}\n"
            for kind, values in (
                ("gyroscope", (SENSOR.gyro_density, SENSOR.gyro_walk)),
                ("accelerometer", (SENSOR.accel_density, SENSOR.accel_walk)),
            )
            for what, value in zip(("noise_density", "random_walk"), values, strict=True)
        )
    )
    chain = tmp_path / "rig-camchain-imucam.yaml"
    write_imu_calibration(chain, result.rig.eyes, result.rig.T_left_right, found)
    read = read_imu(table).sensor
    np.testing.assert_allclose(read.T_left_imu, found.sensor.T_left_imu, atol=1e-12)
    assert read.time_shift == found.sensor.time_shift
    camera = read_calibration(chain)
    np.testing.assert_allclose(camera.T_left_right, result.rig.T_left_right, atol=1e-12)
    assert camera.left == result.rig.eyes[0]


def test_a_chain_with_a_border_is_solved_as_a_dense_system():
    rng, count, n, b = np.random.default_rng(0), 5, 3, 2
    factors, rows = [], []
    for k in range(count):
        following = rng.normal(size=(4, n)) if k + 1 < count else None
        border = rng.normal(size=(4, b)) if k != 1 else None
        factor = Factor(k, rng.normal(size=4), rng.normal(size=(4, n)), following, border, ())
        row = np.zeros((4, count * n + b))
        row[:, n * k : n * k + n] = factor.own
        if following is not None:
            row[:, n * k + n : n * k + 2 * n] = following
        if border is not None:
            row[:, -b:] = border
        factors.append(factor)
        rows.append(row)
    J, residual = np.concatenate(rows), np.concatenate([each.residual for each in factors])
    dense, *_ = np.linalg.lstsq(J, -residual, rcond=None)
    covariance = np.linalg.inv(J.T @ J)
    system = ArrowSystem(factors, count, n, b)
    steps, shared = system.solve()
    np.testing.assert_allclose(np.r_[steps.ravel(), shared], dense, atol=1e-9)
    last, border = system.last_covariance()
    np.testing.assert_allclose(border, covariance[-b:, -b:], rtol=1e-9)
    np.testing.assert_allclose(last, covariance[-b - n : -b, -b - n : -b], rtol=1e-9)
    spreads = np.concatenate(list(system.spreads()))
    np.testing.assert_allclose(spreads, np.diag(J @ covariance @ J.T), rtol=1e-8)
    after = np.concatenate([each.after(steps, shared) for each in factors])
    np.testing.assert_allclose(after, residual + J @ dense, atol=1e-9)


@pytest.mark.long
def test_derivatives_of_the_inertial_residual():
    rng = np.random.default_rng(5)
    recorded = record(5, 1.0)
    poses = recorded.motion.poses(np.array([0.3, 0.4])) @ se3_inverse(recorded.sensor.T_left_imu)
    T_left_imu, gravity = recorded.sensor.T_left_imu, np.array([0.0, 0.0, -9.8])
    state = _State(poses, 0.2 * rng.normal(size=(2, 3)), np.zeros((2, 6)), T_left_imu, gravity, 0.02)

    def residual(step: np.ndarray) -> np.ndarray:
        moved = state.moved(step[:30].reshape(2, 15), step[30:])
        ends = 0.3 + moved.shift, 0.4 + moved.shift
        bias = moved.biases[0]
        motion = preintegrate(recorded.samples, *ends, bias[:3], bias[3:], SENSOR.spectra, np.ones(2))
        return _inertial(moved, 0, motion)[0]

    motion = preintegrate(recorded.samples, 0.32, 0.42, np.zeros(3), np.zeros(3), SENSOR.spectra, np.ones(2))
    _, J, K, border = _inertial(state, 0, motion)
    h = 1e-6 * np.eye(40)
    numeric = np.stack([(residual(step) - residual(-step)) / 2e-6 for step in h], axis=1)
    found = np.concatenate([J, K, np.r_[border, np.zeros((6, 10))]], axis=1)
    # First order in a rotation residual of some milliradians, and in samples that are 5 ms apart.
    np.testing.assert_allclose(found, numeric, atol=0.02)


def test_what_cannot_be_calibrated_is_refused():
    recorded = record(2, 2.0)
    times = np.arange(0.0, 2.0, 0.1)
    poses = recorded.motion.poses(times) @ se3_inverse(recorded.sensor.T_left_imu)
    spread = np.tile(1e-6 * np.eye(6), (len(times), 1, 1))
    start = replace(SENSOR, T_left_imu=np.eye(4))
    path = CameraPath(times, poses, spread, np.zeros((len(times), 6, 0)))
    with pytest.raises(CalibrationError, match="5 images with a pose"):
        calibrate_imu(path.select(np.arange(5)), recorded.samples, start)
    faster = replace(recorded.samples, gyro=recorded.samples.gyro * 180 / np.pi)
    with pytest.raises(CalibrationError, match="are they in rad/s"):
        calibrate_imu(path, faster, start)


@pytest.mark.long
@pytest.mark.parametrize("signs", [(-1, -1, -1), (1, -1, 1)], ids=["gravity instead of force", "mirrored"])
def test_forces_of_another_motion_are_said(signs: tuple[int, int, int]):
    recorded = record(0, 4.0)
    wrong = replace(recorded, samples=replace(recorded.samples, accel=recorded.samples.accel * signs))
    assert "upwards at rest" in describe_imu_calibration(calibrated(wrong, 0, 4.0))
    assert "upwards at rest" not in describe_imu_calibration(calibrated(recorded, 0, 4.0))


@pytest.mark.long
def test_a_gap_of_several_images_costs_little():
    recorded = record(0, 4.0)
    t = recorded.samples.timestamp
    found = calibrated(replace(recorded, samples=recorded.samples.select((t < 1.0) | (t > 1.3))), 0, 4.0)
    assert np.all(np.abs(recorded.error(found)) < 3.0 * np.sqrt(np.diag(found.covariance)))


@pytest.mark.long
def test_the_command_names_what_is_missing(tmp_path: Path, real_data: Path):
    imu = real_data / "euroc_mh01_f000_099" / "mav0" / "imu0"
    out = tmp_path / "rig.yaml"
    assert_refused(run_here("calibrate", tmp_path, "--out", out), "--board is missing")
    assert_refused(run_here("calibrate", tmp_path, "--imu", imu, "--out", out), "no trajectory.tum")
    board = real_data / "opencv_stereo_chessboard"
    refused = run_here("calibrate", board, "--board", "chessboard:9x6:0.025", "--imu", imu, "--out", out)
    assert_refused(refused, "all names are times in nanoseconds")


@pytest.mark.slow
def test_a_real_run_finds_the_published_rotation_and_no_delay(real_data: Path, tmp_path: Path):
    folder = real_data / "euroc_mh01_f000_099"
    result = run_here("track", folder, "--imu", "off", "--out", tmp_path / "run")
    assert result.returncode == 0, result.stderr
    recording = read_imu(find_imu(folder))
    start = replace(recording.sensor, T_left_imu=np.eye(4))
    found, _ = calibrate_imu_by_run(tmp_path / "run", replace(recording, sensor=start), lambda: None)
    error = Recorded(recording.samples, recording.sensor, Motion(0), np.zeros(6)).error(found)
    assert nees(error[1:4], found.covariance[1:4, 1:4]) < 14.2 / 3.0  # 3 sigma
    assert abs(error[0]) < 1e-3
    assert np.all(np.abs(error[4:]) < 0.03)

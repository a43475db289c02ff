"""Faults of an inertial sensor are named by how the cameras move."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.checks.finding import Finding, wrong
from sigmaslam.checks.inertial import check_inertial
from sigmaslam.checks.inertial_agreement import judge_motion
from sigmaslam.estimation.accelerometer_axes import SIGNED_AXES
from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.se3 import rotation_exp, se3_exp, se3_inverse
from sigmaslam.readers import open_sequence
from sigmaslam.readers.inertial import InertialRecording, find_imu, read_imu
from sigmaslam.slam.tracker import StereoTracker
from tests.support.inertial import SENSOR, Motion

IMAGES = np.arange(0.5, 3.0, 0.05)
T_LEFT_IMU = se3_exp(np.array([0.02, -0.06, 0.01, 0.3, -1.2, 0.5]))
Fault = tuple[str, str | float, InertialRecording]
"""Name of the check, words of its message or its figure, and the recording."""


def changed(recording: InertialRecording, gyro=1.0, accel=1.0, shift=0.0) -> InertialRecording:
    """With rates and forces times a number or turned by a matrix, and stamps that are later."""
    rates, forces = (
        each @ by.T if isinstance(by, np.ndarray) else by * each
        for each, by in ((recording.samples.gyro, gyro), (recording.samples.accel, accel))
    )
    return replace(recording, samples=InertialSamples(recording.samples.timestamp + shift, rates, forces))


def draw_faults(recording: InertialRecording, count: int) -> Iterator[Fault]:
    """Faulty recordings; units, axes, signs and offsets in turn."""
    rng = np.random.default_rng(39)
    flips = [np.diag(signs) for signs in np.array(np.meshgrid(*[[1.0, -1.0]] * 3)).reshape(3, -1).T[1:]]
    for k in range(count):
        if k % 4 == 0:
            name, word, size = [
                ("gyro", "deg/s", 180 / np.pi),
                ("gyro", "mrad/s", 1e3),
                ("inertial sensor", "in g:", 1 / 9.80665),
                ("inertial sensor", "in mg:", 1e3 / 9.80665),
            ][rng.integers(4)]
            yield name, word, changed(recording, **{"gyro" if name == "gyro" else "accel": size})
        elif k % 4 == 3:
            shift = float(rng.choice([-1, 1]) * rng.uniform(0.003, 0.3))
            yield "IMU clock", shift, changed(recording, shift=shift)
        else:
            axes = SIGNED_AXES[rng.integers(8, 48)] if k % 4 == 1 else flips[rng.integers(7)]
            names = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in axes]
            said = ", ".join(names)
            match rng.integers(3):
                case 0:
                    yield "gyro", f"those about {said}", changed(recording, gyro=axes)
                case 1:
                    yield "accelerometer", f"those along {said}", changed(recording, accel=axes)
                case _:
                    yield "T_cam_imu", f"of the sensor are {said}", changed(recording, gyro=axes, accel=axes)


def judged(poses: np.ndarray, times: np.ndarray, recording: InertialRecording) -> list[Finding]:
    found = check_inertial(recording, None)
    return [found, *judge_motion(times, poses, np.ones(len(times), bool), recording)]


def says(found: Finding, name: str, said: str | float) -> bool:
    if isinstance(said, float):
        return found.name == name and found.figure == pytest.approx(said, abs=2e-3)
    return found.name == name and said in found.message


def assert_named(poses: np.ndarray, times: np.ndarray, faults: Iterator[Fault]) -> None:
    missed = []
    for name, said, recording in faults:
        faulty = wrong(judged(poses, times, recording))
        if not any(says(each, name, said) for each in faulty):
            missed.append((name, said, [each.message for each in faulty]))
    assert not missed


def simulated(motion: Motion, noise: float = 3e-4) -> tuple[np.ndarray, InertialRecording]:
    """Poses of a camera with errors in metres and radians, and the sensor beside it."""
    rng = np.random.default_rng(2)
    poses = motion.poses(IMAGES) @ se3_inverse(T_LEFT_IMU) @ se3_exp(noise * rng.normal(size=(len(IMAGES), 6)))
    samples = motion.measure(np.arange(0.0, 4.0, 0.005))
    samples = replace(samples, gyro=samples.gyro + rng.normal(0, 0.003, (len(samples), 3)) + [0.02, -0.01, 0.03])
    return poses, InertialRecording(Path("imu.csv"), replace(SENSOR, T_left_imu=T_LEFT_IMU), samples)


def test_a_right_sensor_is_ok():
    poses, recording = simulated(Motion(5))
    findings = judged(poses, IMAGES, recording)
    assert [each.severity for each in findings] == ["ok"] * 5, findings


@pytest.mark.long
def test_faults_of_a_simulated_sensor_are_named():
    poses, recording = simulated(Motion(5))
    assert_named(poses, IMAGES, draw_faults(recording, 8))


def test_wrong_mountings_are_named():
    poses, recording = simulated(Motion(5))
    for mounting, words in (
        (se3_inverse(T_LEFT_IMU), "invert it"),
        (T_LEFT_IMU @ se3_exp(np.array([0, 0, 0, 0.4, 0.3, -0.2])), "turned by 30."),
        (T_LEFT_IMU @ se3_exp(np.array([0, 0, 0, 0.0, 0.03, 0.0])), "turned by 1."),
        (se3_exp(np.array([0.03, -0.04, 0, 0, 0, 0])) @ T_LEFT_IMU, "beside its place there, at (0.0"),
    ):
        faulty = wrong(judged(poses, IMAGES, replace(recording, sensor=replace(recording.sensor, T_left_imu=mounting))))
        assert [each.name for each in faulty] == ["T_cam_imu"]
        assert words in faulty[0].message
    far = T_LEFT_IMU.copy()
    far[:3, 3] *= 1e3
    found = check_inertial(replace(recording, sensor=replace(recording.sensor, T_left_imu=far)), None)
    assert found.severity == "error"
    assert "millimetres" in found.message


def test_turns_about_one_axis_raise_no_alarm():
    """A car: neither the hand nor the rotation about the vertical shows."""
    heading = np.zeros((len(IMAGES), 3))
    heading[:, 2] = 0.3 * np.sin(2.0 * IMAGES)
    t = np.arange(0.0, 4.0, 0.005)
    rate = np.column_stack([np.zeros((len(t), 2)), 0.6 * np.cos(2.0 * t)])
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (len(IMAGES), 1, 1))
    poses[:, :3, :3] = rotation_exp(heading + 3e-4 * rng.normal(size=heading.shape))
    force = np.tile([0.0, 0.0, 9.80665], (len(t), 1)) + rng.normal(0, 0.05, (len(t), 3))
    samples = InertialSamples(t, rate + rng.normal(0, 0.003, rate.shape), force)
    findings = judge_motion(IMAGES, poses, np.ones(len(IMAGES), bool), InertialRecording(Path("c"), SENSOR, samples))
    assert not wrong(findings)
    assert [each.severity for each in findings if each.name == "T_cam_imu"] == ["unknown"]


def test_another_recording_and_a_camera_at_rest():
    poses, recording = simulated(Motion(5))
    (found,) = judge_motion(IMAGES, simulated(Motion(6))[0], np.ones(len(IMAGES), bool), recording)
    assert found.severity == "error"
    assert "same recording" in found.message
    rest = np.tile(np.eye(4), (len(IMAGES), 1, 1))
    (found,) = judge_motion(IMAGES, rest, np.ones(len(IMAGES), bool), recording)
    assert found.severity == "unknown"
    (found,) = judge_motion(IMAGES, poses, np.zeros(len(IMAGES), bool), recording)
    assert found.severity == "unknown"


@pytest.mark.slow
def test_forty_faults_in_a_real_recording_are_named(real_data):
    """Units, axes, signs and offsets; the recording itself is good wherever one looks at it."""
    folder = real_data / "euroc_mh01_f000_099"
    sequence, recording = open_sequence(folder), read_imu(find_imu(folder))
    tracker = StereoTracker(sequence.camera, threads=1)
    estimates = [tracker.step(frame.left, frame.right, frame.timestamp) for frame in sequence.frames()]
    times = np.array([each.timestamp for each in estimates])
    poses = np.array([each.T_world_camera for each in estimates])
    for first in range(0, 51, 10):
        part = slice(first, first + 50)
        findings = judged(poses[part], times[part], recording)
        assert {each.severity for each in findings} == {"ok"}, findings
    assert_named(poses[:50], times[:50], draw_faults(recording, 40))
    for lever in 0.05 * np.concatenate([np.eye(3), -np.eye(3)]):
        mounting = recording.sensor.T_left_imu.copy()
        mounting[:3, 3] += lever
        beside = replace(recording, sensor=replace(recording.sensor, T_left_imu=mounting))
        faulty = wrong(judged(poses, times, beside))
        assert [each.name for each in faulty] == ["T_cam_imu"]
        assert "mm beside its place there" in faulty[0].message

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.checks.inertial import check_inertial, check_times
from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.odometry_sensor import OdometrySamples, OdometrySensor
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.readers.odometry import OdometryRecording
from tests.support.inertial import SENSOR, Motion

IMAGES = np.arange(0.5, 4.5, 0.05)


def recorded(scale: float = 1.0, shift: float = 0.0, every: int = 1, keep: float = 9.0) -> InertialRecording:
    samples = Motion(0, size=0.1).measure(np.arange(0, 5, 0.005)[::every])
    samples = samples.select((samples.timestamp < keep) | (samples.timestamp > keep + 0.3))
    samples = InertialSamples(samples.timestamp + shift, samples.gyro, scale * samples.accel)
    return InertialRecording(Path("imu.csv"), SENSOR, samples)


def test_a_good_table_is_ok():
    assert check_inertial(recorded(), IMAGES.tolist()).severity == "ok"
    assert check_inertial(recorded(), None).severity == "ok"


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e-3, "micro"), (1e-6, "milli"), (1e3, "milli"), (1e6, "micro"), (1e9, "nano")]
)
def test_other_units_of_time_are_named(factor: float, unit: str):
    """Whole milli- and microseconds since 1970 are read as nanoseconds, smaller ones as seconds."""
    recording = recorded()
    samples = replace(recording.samples, timestamp=factor * recording.samples.timestamp)
    found = check_inertial(replace(recording, samples=samples), (IMAGES - 9.0).tolist())
    assert found.severity == "error"
    assert f"100% of the images lie outside its times: they look like {unit}seconds: give seconds" in found.message
    if factor > 1.0:
        assert f"(are its times {unit}seconds?)" in check_times(replace(recording, samples=samples), None).message


def test_saturation_is_said():
    recording = recorded()
    samples = recording.samples
    clipped = np.clip(20.0 * samples.gyro, -np.radians(250), np.radians(250))
    found = check_inertial(replace(recording, samples=replace(samples, gyro=clipped)), None)
    assert found.severity == "warning"
    assert "the rate stays at 4.36" in found.message
    clipped = np.clip(samples.accel + [12.0, 0.0, 0.0], None, 2 * 9.80665 * 0.6)
    # Flat, but at the end of no sensor's range.
    assert check_inertial(replace(recording, samples=replace(samples, accel=clipped)), None).severity != "warning"
    # A gyro of one axis.
    level = replace(recording, samples=replace(samples, gyro=samples.gyro * [0.0, 0.0, 1.0]))
    assert check_inertial(level, None).severity == "ok"


@pytest.mark.parametrize(
    ("recording", "severity", "message"),
    [
        (recorded(scale=1 / 9.80665), "error", "it is in g: give m/s"),
        (recorded(scale=1000 / 9.80665), "error", "it is in mg"),
        (recorded(scale=0.3), "error", "are its columns those"),
        (recorded(shift=100.0), "error", "100% of the images lie outside its times: is it of the same clock?"),
        (recorded(shift=-2.0), "warning", "of the images lie outside"),
        (recorded(every=10), "warning", "20 samples a second, 0 gaps"),
        (recorded(keep=2.0), "warning", "1 gaps of up to 0.3"),
    ],
)
def test_faults_are_named(recording, severity, message):
    found = check_inertial(recording, IMAGES.tolist())
    assert found.severity == severity
    assert message in found.message


@pytest.mark.parametrize(
    ("period", "shift", "severity", "message"),
    [
        (0.05, 0.0, "ok", "20 samples a second"),
        (0.2, 0.0, "warning", "5 samples a second, 0 gaps of up to 0.20 s: at least 10 without gaps"),
        (0.05, 3.0, "error", "of the images lie outside its time"),
    ],
)
def test_times_of_odometry_are_judged(period, shift, severity, message):
    t = np.arange(0, 5, period)
    samples = OdometrySamples(t, np.zeros((len(t), 3)), np.zeros((len(t), 3)))
    recording = OdometryRecording(Path("wheels.csv"), OdometrySensor(np.eye(4), shift), samples)
    found = check_times(recording, IMAGES.tolist())
    assert (found.name, found.severity) == ("odometry", severity)
    assert message in found.message

"""Inertial sensors of recordings: EuRoC's and TUM-VI's imu0, Kalibr's files, and CSV with a YAML beside."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, finite_number, read_text, shorten
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor
from sigmaslam.geometry.se3 import is_rigid, se3_inverse

# A time stamp above this is in nanoseconds: seconds would be of the year 33658.
_NANOSECONDS_FROM = 1e12
# More of the stamps may not be out of order: then columns or clock are wrong.
_MOST_OUT_OF_ORDER = 0.01
# Names of Kalibr's results, and of TUM-VI's.
_CHAINS = ("camchain-imucam*.yaml", "*-camchain-imucam.yaml", "dso/camchain.yaml", "camchain*.yaml")
_NOISES = ("imu.yaml", "imu_config.yaml", "dso/imu_config.yaml")
_DENSITIES = (
    "gyroscope_noise_density",
    "accelerometer_noise_density",
    "gyroscope_random_walk",
    "accelerometer_random_walk",
)


Sensor = TypeVar("Sensor")
Samples = TypeVar("Samples")


@dataclass(frozen=True)
class SensorRecording(Generic[Sensor, Samples]):
    """What a sensor of motion measured beside the images.

    Attributes:
        source: the table.
        sensor: mounting, clock and noise.
        samples: in the order of time.
        dropped: samples that came out of order and were left out.
    """

    source: Path
    sensor: Sensor
    samples: Samples
    dropped: int = 0


InertialRecording = SensorRecording[InertialSensor, InertialSamples]


def find_imu(folder: Path) -> Path | None:
    """The table of a EuRoC or TUM-VI folder, if it has one that says how the sensor is mounted."""
    tables = (root / "imu0" / "data.csv" for root in (folder, folder / "mav0"))
    return next((table for table in tables if table.is_file() and _find_mounting(table) is not None), None)


def read_imu(path: Path, is_mounted: bool = True) -> InertialRecording:
    """An inertial sensor's table of time, angular rate (rad/s) and specific force (m/s^2), with its YAML.

    Columns of the force may be missing, or empty, for a gyro alone.

    Noise densities come from a YAML of the table's name, from sensor.yaml or from Kalibr's imu.yaml beside it; the
    mounting from T_cam_imu in the first, in Kalibr's camchain, or from T_BS of EuRoC's sensors.

    Args:
        path: of the table, or its folder.
        is_mounted: False: the mounting may be missing, and is the identity then, as before a calibration.
    Raises:
        InputError: the table is missing, or a row is no time and six numbers, or time runs backwards.
        CalibrationError: noise or mounting are missing or wrong.
    """
    path = path / "data.csv" if path.is_dir() else path
    seconds, values = _read_table(path)
    lacking = np.isnan(values).any(axis=1)
    if 0 < lacking.sum() < len(lacking):
        raise InputError(f"{path}: {lacking.sum()} of {len(lacking)} rows lack the specific force: give all or none")
    is_whole = not lacking.any()
    return record(path, seconds, np.nan_to_num(values), read_sensor(path, is_mounted, is_whole))


def record(source: Path, seconds: np.ndarray, values: np.ndarray, sensor: InertialSensor) -> InertialRecording:
    """Samples in the order of time; those out of order are left out.

    Args:
        source: named in messages.
        seconds: (N,) times of the sensor's clock.
        values: (N, 6) angular rate and specific force.
        sensor: mounting and noise.
    Raises:
        InputError: there are fewer than two samples, or time runs backwards.
    """
    later = in_order(source, seconds)
    seconds, values = seconds[later], values[later]
    samples = InertialSamples(seconds, values[:, :3], values[:, 3:])
    return InertialRecording(source, sensor, samples, int((~later).sum()))


def in_order(source: Path, seconds: np.ndarray) -> np.ndarray:
    """(N,) bool, which samples increase, by those before or by those behind; InputError where there are too few."""
    if len(seconds) < 2:
        raise InputError(f"{source}: has {len(seconds)} samples; give the sensor's table")
    later = np.r_[True, seconds[1:] > np.maximum.accumulate(seconds)[:-1]]
    # One of the future makes all that follow early.
    earlier = np.r_[seconds[:-1] < np.minimum.accumulate(seconds[::-1])[-2::-1], True]
    later = max(later, earlier, key=np.count_nonzero)
    dropped = int((~later).sum())
    if dropped > _MOST_OUT_OF_ORDER * len(seconds):
        raise InputError(f"{source}: {dropped} of {len(seconds)} time stamps do not increase: sort the samples by time")
    return np.asarray(later)


def describe_lack(table: Path) -> str | None:
    """What of a sensor no file beside its table, or bag, says, and how to give it; None where all is known."""
    own = table.with_suffix(".yaml").name
    if _noise_file(table) is None:
        return (
            f"nothing says how noisy the sensor is: put {own} beside it, with {', '.join(_DENSITIES)} and T_cam_imu, "
            "or Kalibr's imu.yaml"
        )
    if _find_mounting(table) is None:
        return f"nothing says where the sensor is: give T_cam_imu in {own}, or Kalibr's camchain-imucam.yaml beside it"
    return None


def read_sensor(table: Path, is_mounted: bool = True, has_accelerometer: bool = True) -> InertialSensor:
    """Mounting and noise from the files beside a table or bag; CalibrationError where they are missing or wrong."""
    noise, mounting = _noise_file(table), _find_mounting(table) or (None if is_mounted else (np.eye(4), 0.0))
    if noise is None or mounting is None:
        raise CalibrationError(f"{table}: {describe_lack(table)}")
    values = []
    for name in _DENSITIES:
        value = noise.number(name) if has_accelerometer or name.startswith("gyro") else np.inf
        if value <= 0.0:
            raise noise.error(f"{name} is {value:g}: give the density of the data sheet, above zero")
        values.append(value)
    gyro, accel, gyro_walk, accel_walk = values
    return InertialSensor(mounting[0], gyro, accel, gyro_walk, accel_walk, mounting[1], has_accelerometer)


def _read_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    lines = read_text(path, TABLE_BYTES, "the inertial samples").splitlines()
    rows, stamps = [], []
    for number, row in enumerate(csv.reader(lines), start=1):
        if not row or row[0].lstrip().startswith("#") or (number == 1 and np.isnan(finite_number(row[0]))):
            continue
        try:
            seconds, values = parse_stamp(row[0]), [float(each) for each in [*row[1:4], *filter(str.strip, row[4:7])]]
        except ValueError:
            values, seconds = [], np.nan
        if len(values) not in (3, 6) or not np.isfinite([seconds, *values]).all():
            raise InputError(
                f"{path}: line {number}: expected time, angular rate x, y, z in rad/s and specific force x, y, z in "
                f"m/s^2, found {shorten(','.join(row))}"
            )
        stamps.append(seconds)
        rows.append(values if len(values) == 6 else [*values, np.nan, np.nan, np.nan])
    return np.array(stamps), np.array(rows).reshape(-1, 6)


def parse_stamp(text: str) -> float:
    """Seconds, of seconds or whole nanoseconds; ValueError where it is neither."""
    stamp = text.strip()
    return int(stamp) / 1e9 if float(stamp) > _NANOSECONDS_FROM and "." not in stamp else float(stamp)


def _noise_file(table: Path) -> CalibrationYaml | None:
    beside = [table.with_suffix(".yaml"), table.parent / "sensor.yaml"]
    folders = (table.parent, table.parent.parent, table.parent.parent.parent)
    beside += [folder / name for folder in folders for name in _NOISES]
    for path in beside:
        if path.is_file():
            content = CalibrationYaml.read(path)
            section = content.section("imu0") if isinstance(content.entries.get("imu0"), dict) else content
            if any(name in section.entries for name in _DENSITIES):
                return section
    return None


def _find_mounting(table: Path) -> tuple[np.ndarray, float] | None:
    """T_left_imu (4, 4), and the sensor's clock minus the camera's, seconds."""
    own = table.with_suffix(".yaml")
    if own.is_file() and "T_cam_imu" in (content := CalibrationYaml.read(own)).entries:
        return read_rigid(content, "T_cam_imu"), content.number("timeshift_cam_imu", 0.0)
    for folder in (table.parent, table.parent.parent, table.parent.parent.parent):
        for pattern in _CHAINS:
            for path in sorted(folder.glob(pattern)):
                content = CalibrationYaml.read(path)
                left = content.section("cam0") if isinstance(content.entries.get("cam0"), dict) else content
                if "T_cam_imu" in left.entries:
                    return read_rigid(left, "T_cam_imu"), left.number("timeshift_cam_imu", 0.0)
    sensor, camera = table.parent / "sensor.yaml", table.parent.parent / "cam0" / "sensor.yaml"
    if not camera.is_file():
        camera = table.parent.parent / "cam0_sensor.yaml"
    if sensor.is_file() and camera.is_file():
        T_body_imu, T_body_left = (read_rigid(CalibrationYaml.read(path), "T_BS") for path in (sensor, camera))
        return se3_inverse(T_body_left) @ T_body_imu, 0.0
    return None


def read_rigid(content: CalibrationYaml, key: str) -> np.ndarray:
    """A rigid transform (4, 4), in rows or as OpenCV writes matrices."""
    T = content.transform(key)
    if not is_rigid(T):
        raise content.error(f"{key} is no rotation with a translation: {T.tolist()}")
    return T

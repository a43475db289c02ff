"""inertial.csv of a run: roll and pitch, the upward direction and biases of each frame, from when gravity is known."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.run_record.appended_file import AppendedFile
from sigmaslam.run_record.pose_file import PoseRecords
from sigmaslam.slam.inertial_estimate import InertialEstimate, level_world
from sigmaslam.table import Table

INERTIAL_NAME = "inertial.csv"
_AXES = "xyz"
COLUMNS = (
    *("timestamp", "roll", "pitch", "roll_sigma", "pitch_sigma"),
    *(f"up_{axis}" for axis in _AXES),
    "tilt_sigma",
    *(f"gyro_bias_{axis}" for axis in _AXES),
    *(f"gyro_bias_sigma_{axis}" for axis in _AXES),
    *(f"accel_bias_{axis}" for axis in _AXES),
    *(f"accel_bias_sigma_{axis}" for axis in _AXES),
)
"""Seconds; radians; the unit vector away from the ground in the left camera's frame, with the sigma of its direction;
rad/s; m/s^2."""


@dataclass(frozen=True, slots=True)
class InertialRecords(Table):
    """Frames with a known gravity.

    Attributes:
        timestamp: (N,) seconds.
        level: (N, 4) roll, pitch and their standard deviations, radians.
        up: (N, 3) in the left camera's frame.
        tilt_sigma: (N,) of its direction, radians.
        biases: (N, 6) of gyro and accelerometer.
        bias_sigmas: (N, 6).
    """

    timestamp: np.ndarray
    level: np.ndarray
    up: np.ndarray
    tilt_sigma: np.ndarray
    biases: np.ndarray
    bias_sigmas: np.ndarray


class InertialWriter(AppendedFile):
    """Appends rows to the file in the folder of a run, a new one or one that goes on."""

    def __init__(self, folder: Path, goes_on: bool = False) -> None:
        goes_on = goes_on and (folder / INERTIAL_NAME).is_file()
        super().__init__(folder / INERTIAL_NAME, goes_on)
        if not goes_on:
            self.append(f"{','.join(COLUMNS)}\n".encode())

    def add(self, timestamp: float, estimate: InertialEstimate) -> None:
        """Takes a frame; it is on disk when this returns."""
        numbers = [
            *(estimate.roll, estimate.pitch, *estimate.sigmas, *estimate.up, estimate.tilt_sigma),
            *(*estimate.gyro_bias, *estimate.gyro_bias_sigma, *estimate.accel_bias, *estimate.accel_bias_sigma),
        ]
        self.append(f"{timestamp:.9f},{','.join(f'{number:.7g}' for number in numbers)}\n".encode())


def read_inertial_records(folder: Path) -> InertialRecords | None:
    """The file of a run; None where it has none. A last row that was cut off does not count.

    Raises:
        InputError: it has other columns, or something that is no number.
    """
    path = folder / INERTIAL_NAME
    if not path.is_file():
        return None
    head, *lines = read_text(path, TABLE_BYTES, "the inertial sensor's states").split("\n")
    rows = [line.split(",") for line in lines[:-1]]
    try:
        table = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS))
    except ValueError as error:
        raise InputError(f"{path}: is no table of numbers ({error}): run `sigmaslam track` again") from error
    if head != ",".join(COLUMNS):
        raise InputError(f"{path}: has other columns than {', '.join(COLUMNS)}: run `sigmaslam track` again")
    biases, sigmas = (np.c_[table[:, k : k + 3], table[:, k + 6 : k + 9]] for k in (9, 12))
    return InertialRecords(table[:, 0], table[:, 1:5], table[:, 5:8], table[:, 8], biases, sigmas)


def cut_inertial_records(folder: Path, last: float) -> None:
    """Leaves the whole rows up to a time stamp in the file, where there is one."""
    path = folder / INERTIAL_NAME
    if path.is_file():
        head, *lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [each for each in lines if each.endswith("\n") and float(each.split(",")[0]) < last + 1e-6]
        atomic_write_text(path, "".join([head, *kept]))


def describe_gravity(inertial: InertialRecords | None, poses: PoseRecords) -> dict[str, Any]:
    """Entries of run.json: `T_gravity` of the frame that knows it best, its sigma, and where up is in the end."""
    if inertial is None or not len(inertial):
        return {}
    rows = np.searchsorted(poses.timestamp, inertial.timestamp - 1e-6)
    known = np.flatnonzero(rows < len(poses))
    if not len(known):
        return {}
    rotation = np.linalg.eigvalsh(poses.covariance[rows[known], 3:, 3:])[:, -1]
    variance = inertial.tilt_sigma[known] ** 2 + rotation
    best = int(np.argmin(variance))
    k = known[best]
    T = level_world(poses.pose[rows[k]], inertial.up[k])
    roll, pitch, *sigmas = np.degrees(inertial.level[-1]).tolist()
    return {
        "gravity": {
            "T_gravity": T.tolist(),
            "sigma": float(np.sqrt(variance[best])),
            "since": float(inertial.timestamp[0]),
            "roll_deg": [roll, sigmas[0]],
            "pitch_deg": [pitch, sigmas[1]],
        }
    }

"""Trajectory files: TUM, KITTI and the ground truth of EuRoC."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from sigmaslam.bounded_files import finite_number, load_array, shorten, table_lines
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.se3 import matrix_to_quaternion, nearest_rotation, quaternion_to_matrix, rigid_motion
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.pairing import check_increase

TrajectoryFormat = Literal["tum", "kitti", "euroc"]

KITTI_FRAME_RATE = 10.0
"""Frames per second of KITTI, used where a pose file has no times.txt."""


def trajectory_format(path: str | Path) -> TrajectoryFormat:
    """The format, from the first line that is not a comment.

    Commas make it EuRoC, eight columns TUM, twelve KITTI.

    Raises:
        InputError: the file cannot be read, is empty, or has another number of columns.
    """
    path = Path(path)
    for number, line in table_lines(path, "the trajectory"):
        if "," in line:
            return "euroc"
        columns = len(line.split())
        if columns == 8:
            return "tum"
        if columns == 12:
            return "kitti"
        raise InputError(
            f"{path}: line {number} has {columns} columns; a trajectory has 8 (TUM: t x y z qx qy qz qw), "
            "12 (KITTI: 3x4 matrix by rows), or commas (EuRoC ground truth)"
        )
    raise InputError(f"{path}: holds no poses; give a trajectory in TUM, KITTI or EuRoC form")


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory in any of the three forms, which its content determines.

    Raises:
        InputError: the file cannot be read or a line is wrong (the message names file, line and value).
    """
    readers: dict[TrajectoryFormat, Callable[[str | Path], Trajectory]] = {
        "tum": read_tum,
        "kitti": read_kitti,
        "euroc": read_euroc_truth,
    }
    return readers[trajectory_format(path)](path)


def read_covariances(path: Path, count: int) -> np.ndarray:
    """The covariances of a covariance.npy, checked against the number of poses in the trajectory beside it.

    Args:
        count: poses of trajectory.tum.
    Returns:
        (count, 6, 6) float64.
    Raises:
        InputError: it cannot be read, has another shape, or is an archive.
    """
    covariances = load_array(path, "run `sigmaslam track` again")
    if covariances.shape != (count, 6, 6) or covariances.dtype.kind != "f":
        raise InputError(
            f"{path}: is {covariances.dtype} {covariances.shape}, but trajectory.tum beside it has {count} poses and "
            f"needs floating numbers ({count}, 6, 6): both must come from the same run"
        )
    return covariances.astype(np.float64)


def read_tum(path: str | Path) -> Trajectory:
    """Read rows of `t x y z qx qy qz qw` (seconds, metres, T_world_camera); `#` starts a comment.

    Raises:
        InputError: the file cannot be read or a line is wrong.
    """
    path = Path(path)
    rows, numbers = _numbers(path, columns=8, form="TUM: t x y z qx qy qz qw")
    check_increase(path, rows[:, 0].tolist(), numbers)
    return Trajectory(rows[:, 0], _poses(path, rows[:, 1:4], rows[:, 4:8], numbers))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write `t x y z qx qy qz qw` rows; nothing is left behind if it fails.

    Raises:
        InputError: the folder cannot be written.
    """
    rows = np.column_stack([trajectory.positions, matrix_to_quaternion(trajectory.rotations)])
    lines = [
        f"{timestamp:.9f} " + " ".join(f"{value:.12f}" for value in row) + "\n"
        for timestamp, row in zip(trajectory.timestamps, rows, strict=True)
    ]
    atomic_write_text(path, "".join(lines))


def kitti_times_path(path: str | Path) -> Path | None:
    """The times.txt beside a KITTI pose file, or None where there is none."""
    times = Path(path).parent / "times.txt"
    return times if times.is_file() else None


def read_kitti(path: str | Path) -> Trajectory:
    """Read rows of 3x4 matrices T_world_camera (12 columns).

    The rotations, which KITTI writes with seven digits, are made orthonormal. Times are those of times.txt beside the
    file, seconds, and 10 Hz from zero where there is none.

    Raises:
        InputError: a file cannot be read, a line is wrong, or there are not as many times as poses.
    """
    path = Path(path)
    rows, numbers = _numbers(path, columns=12, form="KITTI: 3x4 matrix by rows")
    matrices = rows.reshape(-1, 3, 4)
    rotations = nearest_rotation(matrices[:, :, :3])
    deviation = np.abs(rotations - matrices[:, :, :3]).max(axis=(1, 2))
    wrong = np.flatnonzero(deviation > 1e-3)
    if len(wrong):
        raise InputError(
            f"{path}: line {numbers[wrong[0]]} holds no rotation matrix (off by {deviation[wrong[0]]:.3g}): "
            "each row must be the upper 3x4 part of T_world_camera, by rows"
        )
    poses = rigid_motion(rotations, matrices[:, :, 3])
    times = kitti_times_path(path)
    if times is None:
        return Trajectory(np.arange(len(rows)) / KITTI_FRAME_RATE, poses)
    stamps, stamp_numbers = _numbers(times, columns=1, form="one time in seconds")
    if len(stamps) != len(rows):
        raise InputError(
            f"{path}: {len(rows)} poses, but {times} has {len(stamps)} times: give the times of these poses, "
            "or move the file away to assume 10 Hz"
        )
    check_increase(times, stamps[:, 0].tolist(), stamp_numbers)
    return Trajectory(stamps[:, 0], poses)


def write_kitti(path: str | Path, trajectory: Trajectory, times_path: str | Path | None = None) -> None:
    """Write rows of 3x4 matrices and, where `times_path` is given, the timestamps in seconds.

    Raises:
        InputError: the folder cannot be written.
    """
    rows = trajectory.poses[:, :3, :].reshape(-1, 12)
    atomic_write_text(path, "".join(" ".join(f"{value:.12e}" for value in row) + "\n" for row in rows))
    if times_path is not None:
        atomic_write_text(times_path, "".join(f"{t:.9f}\n" for t in trajectory.timestamps))


def read_euroc_truth(path: str | Path) -> Trajectory:
    """Read EuRoC ground truth and turn its body poses into poses of camera 0.

    Two forms are known: `timestamp_ns, p (3), q as w x y z, ...` (state_groundtruth_estimate0/data.csv) and
    the same with a second timestamp after the first. T_BS is taken from `cam0/sensor.yaml` or
    `cam0_sensor.yaml` in the folder of the file or one of the two above it, or in a folder `mav0` beside it.

    Raises:
        InputError: the file cannot be read, a line is wrong, or T_BS is not found.
    """
    path = Path(path)
    rows, numbers = _numbers(path, columns=None, form="EuRoC: timestamp, p (3), q (4), ...", separator=",")
    # Rows of poses are a tenth of a millisecond apart, or more.
    step = np.ptp(rows[:, 0]) / (len(rows) - 1) if len(rows) > 1 else rows[0, 0]
    if rows.shape[1] == 8 and step < 1e5:
        raise InputError(
            f"{path}: times such as {rows[0, 0]:.9g} in the first of eight columns are no nanoseconds, so this is no "
            "EuRoC truth; TUM form has spaces: replace each comma by a space (t x y z qx qy qz qw)"
        )
    # A second column as large as a time in nanoseconds is a time stamp, no position.
    first = 2 if rows.shape[1] > 1 and abs(rows[0, 1]) > 1e15 else 1
    if rows.shape[1] < first + 7:
        raise InputError(
            f"{path}: line {numbers[0]} has {rows.shape[1]} columns; EuRoC ground truth has at least "
            f"{first + 7}: timestamp in ns, p_x, p_y, p_z, q_w, q_x, q_y, q_z"
        )
    timestamps = rows[:, 0] / 1e9
    check_increase(path, timestamps.tolist(), numbers)
    quaternions = rows[:, [first + 4, first + 5, first + 6, first + 3]]
    T_world_body = _poses(path, rows[:, first : first + 3], quaternions, numbers)
    return Trajectory(timestamps, T_world_body @ _camera_in_body(path))


def _camera_in_body(truth: Path) -> np.ndarray:
    """T_body_camera (4, 4) of camera 0 from the sensor file near the ground truth."""
    folders = [truth.resolve().parent, *list(truth.resolve().parents)[1:3]]
    folders.append(folders[0] / "mav0")
    candidates = [folder / name for folder in folders for name in ("cam0/sensor.yaml", "cam0_sensor.yaml")]
    sensor = next((candidate for candidate in candidates if candidate.is_file()), None)
    if sensor is None:
        raise InputError(
            f"{truth}: EuRoC truth is of the body, and no cam0/sensor.yaml or cam0_sensor.yaml with T_BS is "
            f"in {folders[0]}, its folder mav0 or the two folders above: put it there, or convert the truth to TUM form"
        )
    T_body_camera = CalibrationYaml.read(sensor).transform("T_BS")
    T_body_camera[:3, :3] = nearest_rotation(T_body_camera[:3, :3])
    return T_body_camera


def _numbers(path: Path, columns: int | None, form: str, separator: str | None = None) -> tuple[np.ndarray, list[int]]:
    """All rows as (N, columns) float64 and their line numbers; None takes the columns of the first row."""
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in table_lines(path, "the trajectory"):
        fields = line.split(separator)
        columns = len(fields) if columns is None else columns
        if len(fields) != columns:
            raise InputError(f"{path}: line {number} has {len(fields)} columns, not {columns} ({form})")
        rows.append([finite_number(field) for field in fields])
        for field, value in zip(fields, rows[-1], strict=True):
            if math.isnan(value):
                raise InputError(
                    f"{path}: line {number}: {shorten(repr(field.strip()))} is not a finite number ({form}); "
                    "correct or remove the line"
                )
        numbers.append(number)
    if not rows:
        raise InputError(f"{path}: holds no rows; expected {form}")
    return np.array(rows, dtype=np.float64), numbers


def _poses(path: Path, positions: np.ndarray, quaternions: np.ndarray, numbers: list[int]) -> np.ndarray:
    """Poses (N, 4, 4) of positions (N, 3) and quaternions (N, 4) in x, y, z, w that must be unit."""
    length = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > 1e-2)
    if len(wrong):
        k = wrong[0]
        raise InputError(
            f"{path}: line {numbers[k]}: the quaternion has length {length[k]:.4g}, not 1; "
            "check the order of the columns"
        )
    return rigid_motion(quaternion_to_matrix(quaternions), positions)

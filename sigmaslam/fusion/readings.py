"""Files of a location sensor: GPS, motion capture, an electromagnetic tracker."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, finite_number, read_text, shorten
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import quaternion_to_matrix
from sigmaslam.readers.pairing import in_seconds

_POSITION = ("timestamp", "x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ONE_SIGMA = ("sigma_position",)
_AXIS_SIGMAS = ("sigma_x", "sigma_y", "sigma_z")
_MATRIX = ("cxx", "cxy", "cxz", "cyy", "cyz", "czz")
_ROTATION_SIGMA = "sigma_rotation"
_FORM = (
    f"the first line names the columns: {', '.join((*_POSITION, *_ONE_SIGMA))} and, with rotations, "
    f"{', '.join((*_QUATERNION, _ROTATION_SIGMA))}"
)
# The length of a quaternion may differ from 1 by so much, as files have few digits.
_LENGTH_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class Locations:
    """Readings of a location sensor in its own world, ordered by time.

    Attributes:
        timestamps: (N,) seconds, in the clock of the images, strictly increasing.
        positions: (N, 3) metres.
        rotations: (N, 3, 3) of the sensor's axes in its world; None from a sensor of positions.
        covariances: (N, m, m) metres and radians squared: position along the axes of the sensor's world, m = 3; with
            rotations m = 6, the rotation about the axes of the sensor.
    """

    timestamps: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray | None
    covariances: np.ndarray
    source: Path | None = None

    def __len__(self) -> int:
        return len(self.timestamps)

    def row(self, index: int) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Positions, rotations and covariances of one reading."""
        rotations = None if self.rotations is None else self.rotations[[index]]
        return self.positions[[index]], rotations, self.covariances[[index]]


def read_locations(path: Path) -> Locations:
    """Reads a CSV file of `sigmaslam track --location`.

    Its first line names the columns, in any order: timestamp (seconds, in the clock of the images), x, y, z (metres);
    for poses also qx, qy, qz, qw. The covariance of the position is sigma_position, or sigma_x, sigma_y, sigma_z
    (metres), or cxx, cxy, cxz, cyy, cyz, czz (metres squared); that of the rotation is sigma_rotation (radians, about
    any axis). Other columns are ignored.

    Raises:
        InputError: a column is missing or a value is wrong; the message gives file, line and value.
    """
    try:
        file = io.StringIO(read_text(path, TABLE_BYTES, "the readings"), newline="")
        rows = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV file that can be read ({error}); {_FORM}") from None
    if len(rows) < 2:
        raise InputError(f"{path}: holds no readings; its first line names the columns, each further line is a reading")
    names = [cell.strip().lstrip("#").strip() for cell in rows[0][1]]
    for separator, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and separator in names[0]:
            raise InputError(
                f"{path}, line 1: the columns are separated by {word}: separate them by commas, and write numbers with "
                "a decimal point"
            )
    if not any(math.isnan(finite_number(name)) for name in names):
        raise InputError(f"{path}, line 1: holds numbers; {_FORM}")
    if len(set(names)) < len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}, line 1: column {shorten(double)} stands twice: remove one")
    columns = _columns(path, names)
    table = np.array([_numbers(path, number, row, names, columns) for number, row in rows[1:]])
    in_seconds(path, table[:, columns.index("timestamp")].tolist())
    lines = [number for number, _ in rows[1:]]
    value = dict(zip(columns, table.T, strict=True))
    for k in np.flatnonzero(np.diff(value["timestamp"]) <= 0)[:1]:
        raise InputError(
            f"{path}, line {lines[k + 1]}: timestamp {float(value['timestamp'][k + 1])!r} does not come after "
            f"{float(value['timestamp'][k])!r}; sort the readings by time and leave out double ones"
        )
    covariances = _position_covariances(path, lines, value)
    rotations = None
    if _QUATERNION[0] in value:
        rotations = _rotations(path, lines, np.column_stack([value[name] for name in _QUATERNION]))
        _check_sigma(path, lines, _ROTATION_SIGMA, value[_ROTATION_SIGMA])
        grown = np.zeros((len(table), 6, 6))
        grown[:, :3, :3] = covariances
        grown[:, 3:, 3:] = value[_ROTATION_SIGMA][:, None, None] ** 2 * np.eye(3)
        covariances = grown
    positions = np.column_stack([value[name] for name in _POSITION[1:]])
    return Locations(value["timestamp"], positions, rotations, covariances, path)


def _columns(path: Path, names: list[str]) -> list[str]:
    """The columns to read."""

    def need(some: tuple[str, ...]) -> list[str]:
        missing = [name for name in some if name not in names]
        if missing:
            raise InputError(
                f"{path}, line 1: column {missing[0]} is missing, there are {shorten(', '.join(names), 200)}; {_FORM}"
            )
        return list(some)

    columns = need(_POSITION)
    spreads = [some for some in (_ONE_SIGMA, _AXIS_SIGMAS, _MATRIX) if some[0] in names]
    if len(spreads) != 1:
        raise InputError(
            f"{path}, line 1: the covariance of the position must be given once, there are "
            f"{shorten(', '.join(names), 200)}; "
            f"give the column {_ONE_SIGMA[0]}, or {', '.join(_AXIS_SIGMAS)}, or {', '.join(_MATRIX)}"
        )
    columns += need(spreads[0])
    if any(name in names for name in _QUATERNION):
        columns += need((*_QUATERNION, _ROTATION_SIGMA))
    return columns


def _numbers(path: Path, line: int, row: list[str], names: list[str], columns: list[str]) -> list[float]:
    if len(row) != len(names):
        raise InputError(f"{path}, line {line}: {len(row)} values for {len(names)} columns; mend or remove the line")
    cells = dict(zip(names, row, strict=True))
    values = []
    for name in columns:
        values.append(finite_number(cells[name]))
        if math.isnan(values[-1]):
            raise InputError(
                f"{path}, line {line}: {name} is {shorten(repr(cells[name]))}, no number; mend or remove the line"
            )
    return values


def _check_sigma(path: Path, lines: list[int], name: str, sigma: np.ndarray) -> None:
    for k in np.flatnonzero(sigma <= 0)[:1]:
        raise InputError(f"{path}, line {lines[k]}: {name} is {sigma[k]:g}; a standard deviation is larger than zero")


def _position_covariances(path: Path, lines: list[int], value: dict[str, np.ndarray]) -> np.ndarray:
    if _MATRIX[0] in value:
        xx, xy, xz, yy, yz, zz = (value[name] for name in _MATRIX)
        rows = [np.stack(row, axis=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
        covariances = np.stack(rows, axis=-2)
        for k in np.flatnonzero(np.linalg.eigvalsh(covariances)[:, 0] <= 0)[:1]:
            raise InputError(
                f"{path}, line {lines[k]}: {', '.join(_MATRIX)} are no covariance, an eigenvalue is not larger than "
                "zero; give variances and covariances in metres squared"
            )
        return covariances
    names = _AXIS_SIGMAS if _AXIS_SIGMAS[0] in value else _ONE_SIGMA * 3
    for name in names:
        _check_sigma(path, lines, name, value[name])
    sigma = np.column_stack([value[name] for name in names])
    return np.asarray(sigma[:, None, :] ** 2 * np.eye(3))


def _rotations(path: Path, lines: list[int], quaternions: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(np.abs(length - 1.0) > _LENGTH_TOLERANCE)[:1]:
        raise InputError(
            f"{path}, line {lines[k]}: the quaternion qx, qy, qz, qw has length {length[k]:.4g}, a rotation's has 1; "
            "check the order of the columns"
        )
    return quaternion_to_matrix(quaternions)

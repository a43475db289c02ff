"""Recordings of one's own: a folder of CSV files with a header."""

import csv
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam_localisation.recording import PlanarTruth, Recording

KINDS = {"range-bearing": ["range", "bearing"], "cartesian": ["ahead", "left"]}
LONGEST_GAP = 0.5
"""Seconds between poses of the truth above which nothing is interpolated."""

LONGEST_SILENCE = 3600.0
"""Seconds between the first or last sighting and the first or last control."""


def read_csv_folder(folder: Path, mapping: bool = False, associated: bool = True) -> Recording:
    """One robot's recording.

    The files are landmarks.csv (landmark,x,y), controls.csv (time,speed,turn_rate), sightings.csv
    (time,landmark,range,bearing or time,landmark,ahead,left; without landmark where it is to be found) and, if there is
    a truth, truth.csv (time,x,y,heading): seconds, metres, radians.

    Args:
        folder: of the files.
        mapping: the landmarks are to be found, so landmarks.csv need not be there, nor name them all.
        associated: sightings must say which landmark they are of.
    Raises:
        InputError: a file is missing, or has other columns, or names a landmark that is not in the map.
    """
    names: list[str] = []
    places = np.zeros((0, 2))
    if not mapping or (folder / "landmarks.csv").is_file():
        names, places = _read(folder / "landmarks.csv", ["landmark", "x", "y"], named=0)
    _, controls = _read(folder / "controls.csv", ["time", "speed", "turn_rate"])
    path = folder / "sightings.csv"
    header = _header(path)
    kind = next((kind for kind, columns in KINDS.items() if columns == header[-2:]), None)
    if kind is not None and not associated and "landmark" not in header:
        seen, sightings = _read(path, ["time", *KINDS[kind]])
    elif kind is not None:
        seen, sightings = _read(path, ["time", "landmark", *KINDS[kind]], named=1)
    else:
        raise InputError(f"{path}: the header is {','.join(header)}, not time,landmark,range,bearing or ..,ahead,left")
    if len(set(names)) < len(names):
        raise InputError(f"{folder / 'landmarks.csv'}: a landmark stands twice")
    if kind == "range-bearing" and (sightings[:, 1] <= 0.0).any():
        raise InputError(f"{path}: a range is not positive")
    if kind == "range-bearing" and (largest := np.abs(sightings[:, 2]).max()) > 2 * np.pi:
        raise InputError(f"{path}: a bearing is {largest:.4g}, beyond a turn: give radians")
    first, last = ([end(each[:, 0]) for each in (controls, sightings)] for end in (np.min, np.max))
    if (apart := max(abs(first[0] - first[1]), abs(last[0] - last[1]))) > LONGEST_SILENCE:
        raise InputError(f"{path}: sightings begin or end {apart:.4g} s off the controls: give one clock, seconds")
    unknown = sorted(set(seen) - set(names))
    if unknown and not mapping:
        raise InputError(
            f"{path}: landmark {unknown[0]} is not in landmarks.csv: add it there, leave it out here, or find the map"
            " by --map unknown"
        )
    names, places = names + unknown, np.vstack([places, np.full((len(unknown), 2), np.nan)])
    index = {name: place for place, name in enumerate(names)}
    controls = controls[np.argsort(controls[:, 0], kind="stable")]
    controls = controls[np.append(np.diff(controls[:, 0]) > 0, True)]
    order = np.argsort(sightings[:, 0], kind="stable")
    truth = None
    if (folder / "truth.csv").is_file():
        _, poses = _read(folder / "truth.csv", ["time", "x", "y", "heading"])
        poses = poses[np.unique(poses[:, 0], return_index=True)[1]]
        truth = PlanarTruth(poses[:, 0], np.column_stack([poses[:, 1:3], np.unwrap(poses[:, 3])]), LONGEST_GAP)
    return Recording(
        folder.resolve().name,
        controls[:, 0],
        controls[:, 1:],
        sightings[order, 0],
        np.array([index[seen[place]] if seen else -1 for place in order], int),
        sightings[order, 1:],
        kind,
        places,
        truth=truth,
        names=tuple(names),
    )


def _header(path: Path) -> list[str]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return [name.strip() for name in next(csv.reader(file), [])]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error


def _read(path: Path, columns: list[str], named: int | None = None) -> tuple[list[str], np.ndarray]:
    """Names in one column, and the numbers (N, ·) in the others."""
    if _header(path) != columns:
        raise InputError(f"{path}: the header is {','.join(_header(path))}, not {','.join(columns)}")
    names, numbers = [], []
    with path.open(newline="", encoding="utf-8-sig") as file:
        for line, row in enumerate(csv.reader(file), start=1):
            if line == 1 or not row:
                continue
            try:
                if len(row) != len(columns):
                    raise ValueError(f"{len(row)} columns")
                numbers.append([float(cell) for column, cell in enumerate(row) if column != named])
                if not np.isfinite(numbers[-1]).all():
                    raise ValueError("a number that is not finite")
            except ValueError as error:
                raise InputError(f"{path}: line {line} is not {','.join(columns)} ({error})") from error
            if named is not None:
                names.append(row[named].strip())
    table = np.array(numbers).reshape(len(numbers), len(columns) - (named is not None))
    if not len(table):
        raise InputError(f"{path}: has no rows")
    return names, table

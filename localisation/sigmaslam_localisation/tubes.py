"""Recordings in the form of "Lost in the Woods" (Barfoot): a MATLAB file of one robot with a laser among tubes."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from sigmaslam.errors import InputError
from sigmaslam_localisation.recording import PlanarTruth, Recording


def read_tubes(path: Path) -> Recording:
    """The robot's odometry and its laser's sightings of tubes.

    Raises:
        InputError: the file cannot be read, or misses a variable.
    """
    file = read_mat(path, ("t", "l", "r", "b", "d", "v", "om"))
    seconds = file["t"].ravel()
    ranges, bearings = file["r"], file["b"]
    seen = ranges > 0
    step, landmark = np.nonzero(seen)
    truth = None
    if {"x_true", "y_true", "th_true", "true_valid"} <= file.keys():
        valid = file["true_valid"].ravel() == 1
        poses = np.column_stack([file[key].ravel()[valid] for key in ("x_true", "y_true", "th_true")])
        poses[:, 2] = np.unwrap(poses[:, 2])
        truth = PlanarTruth(seconds[valid], poses, 1.5 * float(np.median(np.diff(seconds))))
    return Recording(
        path.stem,
        seconds,
        np.column_stack([file["v"].ravel(), file["om"].ravel()]),
        seconds[step],
        landmark,
        np.column_stack([ranges[seen], bearings[seen]]),
        "range-bearing",
        file["l"],
        float(file["d"].ravel()[0]),
        truth,
        odometry=True,
    )


def read_mat(path: Path, required: tuple[str, ...]) -> dict[str, Any]:
    """The variables of a MATLAB file, in double precision.

    Raises:
        InputError: it cannot be read, or misses a variable.
    """
    try:
        file = loadmat(path)
    except (OSError, ValueError, NotImplementedError, MatReadError) as error:
        raise InputError(f"{path}: is no MATLAB file that can be read ({error}): save it with -v7") from error
    missing = [name for name in required if name not in file]
    if missing:
        raise InputError(f"{path}: misses the variable {missing[0]}: another --format may fit")
    numbers = {
        name: value for name, value in file.items() if isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }
    return {name: value.astype(float) for name, value in numbers.items()}

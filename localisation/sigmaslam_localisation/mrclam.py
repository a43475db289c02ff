"""Recordings in the form of the UTIAS MRCLAM data: robots in a room of barcodes (Leung et al. 2011)."""

import re
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam_localisation.recording import PlanarTruth, Recording

LONGEST_GAP = 0.2
"""Seconds between poses of the truth above which nothing is interpolated."""


def find_robots(folder: Path) -> list[int]:
    """Numbers of the robots that a folder has measurements of."""
    names = (re.fullmatch(r"Robot(\d+)_Measurement\.dat(\.gz)?", path.name) for path in folder.iterdir())
    return sorted({int(name[1]) for name in names if name})


def read_mrclam(folder: Path, robot: int) -> Recording:
    """One robot's commands and its sightings of landmarks; sightings of robots and misread barcodes are left out.

    Raises:
        InputError: a file is missing or has other columns.
    """
    barcodes = _read(folder, "Barcodes.dat", 2)
    landmarks = _read(folder, "Landmark_Groundtruth.dat", 5)
    odometry = _read(folder, f"Robot{robot}_Odometry.dat", 3)
    sightings = _read(folder, f"Robot{robot}_Measurement.dat", 4)
    index_of_subject = {int(subject): index for index, subject in enumerate(landmarks[:, 0])}
    index_of_barcode = {
        int(barcode): index_of_subject[int(subject)]
        for subject, barcode in barcodes
        if int(subject) in index_of_subject
    }
    landmark = np.array([index_of_barcode.get(int(barcode), -1) for barcode in sightings[:, 1]])
    # A camera in a dead cell says 0 m.
    known = (landmark >= 0) & (sightings[:, 2] > 0)
    sightings, landmark = sightings[known], landmark[known]
    order = np.argsort(sightings[:, 0], kind="stable")
    # Of commands with one time the last holds.
    odometry = odometry[np.argsort(odometry[:, 0], kind="stable")]
    odometry = odometry[np.append(np.diff(odometry[:, 0]) > 0, True)]
    return Recording(
        f"robot {robot}",
        odometry[:, 0],
        odometry[:, 1:3],
        sightings[order, 0],
        landmark[order],
        sightings[order, 2:4],
        "range-bearing",
        landmarks[:, 1:3],
        truth=_read_truth(folder, robot),
        names=tuple(f"{subject:.0f}" for subject in landmarks[:, 0]),
    )


def _read_truth(folder: Path, robot: int) -> PlanarTruth | None:
    name = f"Robot{robot}_Groundtruth.dat"
    if _path(folder, name) is None:
        return None
    truth = _read(folder, name, 4)
    truth = truth[np.append(True, np.diff(truth[:, 0]) > 0)]
    return PlanarTruth(truth[:, 0], np.column_stack([truth[:, 1:3], np.unwrap(truth[:, 3])]), LONGEST_GAP)


def _path(folder: Path, name: str) -> Path | None:
    """The file, packed by gzip or not."""
    return next((path for path in (folder / name, folder / f"{name}.gz") if path.is_file()), None)


def _read(folder: Path, name: str, columns: int) -> np.ndarray:
    path = _path(folder, name)
    if path is None:
        raise InputError(f"{folder / name}: is not there, nor {name}.gz: give the folder of an MRCLAM data set")
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is no table of numbers ({error})") from error
    if rows.shape[1] != columns:
        raise InputError(f"{path}: has {rows.shape[1]} columns, not {columns}: is it an MRCLAM file?")
    return rows

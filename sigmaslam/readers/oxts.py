"""Packets of an OXTS RT3003 as KITTI raw has them, in a folder oxts or in one table, as an inertial sensor."""

import csv
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text, shorten
from sigmaslam.calibration_files.kitti_calibration import read_rectification, read_rigid
from sigmaslam.errors import InputError
from sigmaslam.readers.pairing import parse_seconds

# Of KITTI's dataformat.txt: numbers in a packet, and which are specific force and angular rate of the sensor's axes.
_NUMBERS, _FORCE, _RATE = 30, slice(11, 14), slice(17, 20)
# RT3003 within minutes, rad/s^2 and m/s^3 per root hertz: its data sheet has biases stable to 2 degrees an hour and to
# millimetres per second squared.
RT3003_WALKS = (1e-6, 5e-4)


def is_oxts(path: Path) -> bool:
    """Whether this is KITTI raw's folder oxts, or a table with such packets in its last column."""
    if path.is_dir():
        return (path / "data").is_dir() and (path / "timestamps.txt").is_file()
    with path.open(errors="replace") as file:
        rows = [file.readline(1000).rsplit(",", 1)[-1].split() for _ in range(2)]
    return len(rows[1]) == _NUMBERS


def read_packets(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) in seconds, and (N, 6) angular rate and specific force in axes forward, left, up.

    Args:
        path: the folder, or a table with a head and rows `packet_index,seconds,is_rejected,packet`, of which those are
            left out that are rejected.
    Raises:
        InputError: a packet is not 30 finite numbers, or there is not one time for each.
    """
    if path.is_dir():
        files = sorted((path / "data").glob("*.txt"))
        texts = [(str(each), read_text(each, TABLE_BYTES, "the packet")) for each in files]
        stamps = read_text(path / "timestamps.txt", TABLE_BYTES, "the timestamps").split("\n")
        stamps = [each.strip() for each in stamps if each.strip()]
        if len(stamps) != len(texts):
            raise InputError(f"{path / 'timestamps.txt'}: {len(stamps)} times for {len(texts)} packets: give one each")
    else:
        rows = list(csv.reader(read_text(path, TABLE_BYTES, "the packets").splitlines()))[1:]
        kept = [(k, row) for k, row in enumerate(rows, start=2) if len(row) != 4 or row[2].strip() != "1"]
        texts = [(f"{path}: line {k}", row[-1] if row else "") for k, row in kept]
        stamps = [row[1] if len(row) == 4 else "" for _, row in kept]
    seconds, packets = [], []
    for (where, text), stamp in zip(texts, stamps, strict=True):
        try:
            seconds.append(parse_seconds(stamp))
            packets.append([float(each) for each in text.split()])
        except ValueError:
            packets.append([])
        if len(packets[-1]) != _NUMBERS or not np.isfinite([seconds[-1], *packets[-1]]).all():
            raise InputError(
                f"{where}: expected a time and the {_NUMBERS} numbers of an OXTS packet, found {shorten(repr(stamp))} "
                f"and {shorten(repr(text))}"
            )
    table = np.array(packets).reshape(-1, _NUMBERS)
    return np.array(seconds), np.hstack([table[:, _RATE], table[:, _FORCE]])


def estimate_densities(seconds: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """White noise of gyro and accelerometer per root hertz, with the vibrations that packets are too few for.

    By second differences of successive samples, as of `read_packets`, in which slow motion cancels.
    """
    if len(seconds) < 3:
        return 0.0, 0.0
    # The median deviation of a normal variable is 0.67 sigma; a second difference has 1 + 4 + 1 times the variance.
    sigma = np.median(np.abs(np.diff(values, 2, axis=0)), axis=0) / 0.67 / np.sqrt(6.0)
    density = sigma * np.sqrt(np.median(np.diff(seconds)))
    return float(density[:3].max()), float(density[3:].max())


def find_kitti_mounting(path: Path, is_rectified: bool, camera: int) -> np.ndarray | None:
    """T_left_imu (4, 4) by KITTI raw's three calibrations; None where they are not above the packets.

    Args:
        is_rectified: the images are.
        camera: KITTI's number of the left one.
    Raises:
        CalibrationError: a matrix is missing or incomplete, or no rotation.
    """
    names = ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt", "calib_cam_to_cam.txt")
    for folder in path.resolve().parents[:3]:
        imu, velo, cameras = (folder / name for name in names)
        if imu.is_file() and velo.is_file() and cameras.is_file():
            if is_rectified:
                T_left_first = read_rectification(cameras, camera)
            else:
                T_left_first = read_rigid(cameras, f"R_{camera:02d}", f"T_{camera:02d}")
            return T_left_first @ read_rigid(velo, "R", "T") @ read_rigid(imu, "R", "T")
    return None

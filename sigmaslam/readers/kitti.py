"""KITTI odometry and raw folders."""

from pathlib import Path

import numpy as np

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.readers.images import ImagePairs, RawPair
from sigmaslam.readers.pairing import default_times, frame_numbers, pair_by_name, read_times
from sigmaslam.readers.stereo_sequence import StereoSequence

# Each row has the left folder, the right folder and KITTI's numbers of their cameras. Grey goes before colour.
LAYOUTS = (
    ("image_0", "image_1", (0, 1)),
    ("image_00/data", "image_01/data", (0, 1)),
    ("image_00", "image_01", (0, 1)),
    ("image_l", "image_r", (0, 1)),
    ("image_left", "image_right", (0, 1)),
    ("image_2", "image_3", (2, 3)),
    ("image_02/data", "image_03/data", (2, 3)),
    ("image_02", "image_03", (2, 3)),
)
LOOKED_FOR = "folders " + ", ".join(f"{left} + {right}" for left, right, _ in LAYOUTS)


def find_layout(folder: Path) -> tuple[Path, Path, tuple[int, int]] | None:
    """Left folder, right folder and camera numbers, if `folder` has KITTI's names."""
    for left, right, cameras in LAYOUTS:
        if (folder / left).is_dir() and (folder / right).is_dir():
            return folder / left, folder / right, cameras
    return None


def find_single_eye(folder: Path) -> tuple[str, str] | None:
    """Names of the folder that is there and of the one that is missing, if `folder` has one eye under KITTI's names."""
    for left, right, _ in LAYOUTS:
        for present, missing in ((left, right), (right, left)):
            if (folder / present).is_dir() and not (folder / missing).exists():
                return present, missing
    return None


def open_kitti(folder: Path, calibration: Path | None = None) -> StereoSequence:
    """Open a KITTI folder: images paired by name, calib.txt or calib_cam_to_cam.txt, times.txt.

    Without times.txt (or KITTI raw's timestamps.txt) 10 Hz is taken, with a warning.

    Raises:
        InputError: the folders are missing, the left and right images differ, or the times do not fit.
        CalibrationError: the calibration is missing or does not fit.
    """
    layout = find_layout(folder)
    if layout is None:
        raise InputError(f"{folder}: not a KITTI folder; looked for {LOOKED_FOR}")
    left_folder, right_folder, cameras = layout
    files, whole = pair_by_name(left_folder, right_folder)
    pairs = ImagePairs(files, _timestamps(folder, left_folder, files, whole), folder)
    image_size = common_size(pairs.first_pair)
    camera = read_calibration(calibration or _find_calibration(folder), image_size, cameras)
    return StereoSequence(pairs, camera, folder, "kitti")


def common_size(pair: RawPair) -> tuple[int, int]:
    """(width, height) of both images of a pair, pixels.

    Raises:
        CalibrationError: they differ.
    """
    left, right = ((image.shape[1], image.shape[0]) for image in (pair.left, pair.right))
    if left != right:
        raise CalibrationError(
            f"left and right images have different sizes: {pair.left_name} is {left[0]}x{left[1]}, "
            f"{pair.right_name} is {right[0]}x{right[1]}"
        )
    return left


def _timestamps(folder: Path, left_folder: Path, files: list[tuple[Path, Path]], whole: np.ndarray) -> list[float]:
    numbers = frame_numbers(files)
    for path in (folder / "times.txt", left_folder / "timestamps.txt", left_folder.parent / "timestamps.txt"):
        if path.is_file():
            return read_times(path, len(files), numbers, whole)
    return default_times(numbers or np.flatnonzero(whole).tolist(), folder)


def _find_calibration(folder: Path) -> Path:
    # KITTI raw has one calibration per day, beside the drives.
    candidates = (
        folder / "calib.txt",
        folder / "calib_cam_to_cam.txt",
        folder / "calibration.yaml",
        folder.parent / "calib_cam_to_cam.txt",
    )
    for path in candidates:
        if path.is_file():
            return path
    looked = ", ".join(str(path) for path in candidates)
    raise CalibrationError(f"{folder}: no calibration; looked for {looked}; give one with --calibration")

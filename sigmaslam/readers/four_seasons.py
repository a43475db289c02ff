"""Recordings of the 4Seasons data set: undistorted images named by their time, calibration in a folder beside."""

from pathlib import Path

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.calibration_files.four_seasons_calibration import UNDISTORTED
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.readers.images import ImagePairs
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.pairing import pair_by_stamp, stamped_images
from sigmaslam.readers.stereo_sequence import StereoSequence

LOOKED_FOR = "folders undistorted_images/cam0 + undistorted_images/cam1"


def has_undistorted_images(folder: Path) -> bool:
    """Whether this is a recording."""
    return all((folder / "undistorted_images" / camera).is_dir() for camera in ("cam0", "cam1"))


def open_four_seasons(folder: Path, calibration: Path | None = None) -> StereoSequence:
    """Open a recording: images paired by time stamp; `UNDISTORTED` in it, in calibration/, or in one beside it.

    Raises:
        InputError: the layout is not that of 4Seasons, or a name is no time in nanoseconds.
        CalibrationError: the calibration is missing or wrong.
    """
    if not has_undistorted_images(folder):
        raise InputError(f"{folder}: not a recording of 4Seasons; looked for {LOOKED_FOR}")
    left, right = (stamped_images(folder / "undistorted_images" / camera) for camera in ("cam0", "cam1"))
    if left is None or right is None:
        raise InputError(f"{folder}: names of images must be times in nanoseconds, such as 1602074877621449728.png")
    pairs = ImagePairs(*pair_by_stamp(left, right, folder), folder)
    path = calibration or _find_undistorted(folder)
    return StereoSequence(pairs, read_calibration(path, common_size(pairs.first_pair)), folder, "4seasons")


def _find_undistorted(folder: Path) -> Path:
    folders = [folder, *(top / name for top in (folder, folder.parent) for name in ("calibration", "Calibration"))]
    for candidate in folders:
        if all((candidate / name).is_file() for name in UNDISTORTED):
            return candidate
    raise CalibrationError(
        f"{folder}: no {', '.join(UNDISTORTED)} in {', '.join(map(str, folders))}; give one with --calibration"
    )

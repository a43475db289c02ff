"""A plain folder: left and right images (or left.* and right.* videos) and a calibration."""

from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.readers.images import IMAGE_SUFFIXES, ImagePairs
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.pairing import default_times, pair_by_name, pair_by_stamp, read_times, stamped_images
from sigmaslam.readers.stereo_sequence import StereoSequence
from sigmaslam.readers.video import beside_calibration, find_videos, open_video

# RealSense calls its eyes infra1 and infra2.
EYE_FOLDERS = (("left", "right"), ("infra1", "infra2"))
LOOKED_FOR = "folders left + right (or infra1 + infra2) with images, or images left*.png + right*.png"


def find_eyes(folder: Path) -> tuple[Path, Path] | None:
    """The folders of the left and right images; twice this one where they lie in it as left* and right*."""
    for left, right in EYE_FOLDERS:
        if (folder / left).is_dir() and (folder / right).is_dir():
            return folder / left, folder / right
    if all(any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.glob(f"{eye}*")) for eye in ("left", "right")):
        return folder, folder
    return None


def open_folder(folder: Path, calibration: Path | None = None) -> StereoSequence:
    """Open left and right images with the calibration in the folder, of any form, or the one given.

    Images are paired by the numbers in their names. Times come from times.txt (seconds, a line per pair),
    else from names that are times since 1970 (then the pairing is by time, to 5 ms), else 10 Hz with a warning.

    Raises:
        InputError: a sub-folder is missing, the left and right images differ, or the times do not fit.
        CalibrationError: the calibration is missing or does not fit.
    """
    eyes = find_eyes(folder)
    if eyes is None:
        if find_videos(folder):
            return open_video(folder, calibration)
        raise InputError(f"{folder}: not a stereo folder; looked for {LOOKED_FOR}, or videos left.* + right.*")
    left, right = eyes
    prefixes = ("left", "right") if left == right else ("", "")
    times = folder / "times.txt"
    left_stamps, right_stamps = (stamped_images(eye) for eye in eyes)
    if not times.is_file() and left_stamps is not None and right_stamps is not None:
        files, timestamps = pair_by_stamp(left_stamps, right_stamps, folder)
    else:
        files, whole = pair_by_name(left, right, prefixes)
        if times.is_file():
            timestamps = read_times(times, len(files), whole=whole)
        else:
            timestamps = default_times(np.flatnonzero(whole).tolist(), folder)
    pairs = ImagePairs(files, timestamps, folder)
    camera = beside_calibration(folder, calibration, common_size(pairs.first_pair), zed_export=left == right)
    return StereoSequence(pairs, camera, folder, "folder")

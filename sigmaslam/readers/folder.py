"""A plain folder: left/ and right/ images (or left.* and right.* videos) and calibration.yaml."""

from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam.readers.images import ImagePairs
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.pairing import (
    default_times,
    is_stamp,
    list_images,
    pair_by_name,
    pair_by_stamp,
    read_times,
)
from sigmaslam.readers.stereo_sequence import StereoSequence
from sigmaslam.readers.video import beside_calibration, find_videos, open_video

LOOKED_FOR = "folders left + right with images"


def has_image_folders(folder: Path) -> bool:
    """Whether there are left/ and right/."""
    return (folder / "left").is_dir() and (folder / "right").is_dir()


def open_folder(folder: Path, calibration: Path | None = None) -> StereoSequence:
    """Open left/ and right/ with calibration.yaml, our form or the one given.

    Images are paired by the numbers in their names. Times come from times.txt (seconds, a line per pair),
    else from names that are nanoseconds (then the pairing is by time, to 5 ms), else 10 Hz with a warning.

    Raises:
        InputError: a sub-folder is missing, the left and right images differ, or the times do not fit.
        CalibrationError: the calibration is missing or does not fit.
    """
    if not has_image_folders(folder):
        if find_videos(folder):
            return open_video(folder, calibration)
        raise InputError(f"{folder}: not a stereo folder; looked for {LOOKED_FOR}, or videos left.* + right.*")
    left, right = folder / "left", folder / "right"
    times = folder / "times.txt"
    images = [list_images(eye) for eye in (left, right)]
    if not times.is_file() and all(is_stamp(path.stem) for side in images for path in side):
        stamps = [{int(path.stem): path for path in side} for side in images]
        files, timestamps = pair_by_stamp(stamps[0], stamps[1], folder)
    else:
        files = pair_by_name(left, right)
        timestamps = read_times(times, len(files)) if times.is_file() else default_times(range(len(files)), folder)
    pairs = ImagePairs(files, timestamps, folder)
    camera = beside_calibration(folder, calibration, common_size(pairs.first_pair))
    return StereoSequence(pairs, camera, folder, "folder")

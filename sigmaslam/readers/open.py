"""Opens a stereo sequence of any format."""

import os
from collections.abc import Callable
from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam.readers import bag, euroc, folder, four_seasons, kitti, video
from sigmaslam.readers.stereo_sequence import StereoSequence

_OPENERS: dict[str, Callable[[Path, Path | None], StereoSequence]] = {
    "kitti": kitti.open_kitti,
    "euroc": euroc.open_euroc,
    "4seasons": four_seasons.open_four_seasons,
    "folder": folder.open_folder,
    "video": video.open_video,
}
FORMATS = ("auto", *_OPENERS, "bag")


def open_sequence(
    path: str | os.PathLike[str],
    format: str = "auto",
    calibration: str | os.PathLike[str] | None = None,
    topics: bag.Topics = (None, None),
) -> StereoSequence:
    """Open a stereo sequence; everything that needs no reading of images is checked at once.

    Args:
        path: a folder (KITTI, EuRoC, TUM-VI, 4Seasons, plain, or with two videos), a side-by-side video or a ROS bag.
        format: one of `FORMATS`; 'auto' tries them in that order.
        calibration: replaces the calibration of the format; any that `read_calibration` reads.
        topics: left and right image topic of a bag; None finds the only one whose name tells the eye.

    Raises:
        InputError: the path is missing, of no known format, or left and right do not belong together.
        CalibrationError: the calibration is missing, wrong, or of another image size.
    """
    path = Path(path)
    if format not in FORMATS:
        raise InputError(f"format {format!r} is unknown; use one of {', '.join(FORMATS)}")
    calibration_path = None if calibration is None else Path(calibration)
    try:
        return _open(path, format, calibration_path, topics)
    except OSError as error:  # a folder that may not be read
        raise InputError(
            f"{error.filename or path}: cannot be read ({error.strerror}); give a folder that you may read"
        ) from error


def _open(path: Path, format: str, calibration: Path | None, topics: bag.Topics) -> StereoSequence:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if format == "auto":
        format = _detect(path)
    if format == "bag":
        return bag.open_bag(path, calibration, topics)
    if topics != (None, None):
        raise InputError(f"{path}: topics are given, and the format is {format!r}; only bags have topics")
    if format != "video" and not path.is_dir():
        raise InputError(f"{path}: a file; format {format!r} needs a folder")
    return _OPENERS[format](path, calibration)


def _detect(path: Path) -> str:
    if bag.is_bag(path):
        return "bag"
    if path.is_file():
        return "video"
    if kitti.find_layout(path):
        return "kitti"
    if euroc.find_asl_root(path) or euroc.is_flat(path):
        return "euroc"
    if four_seasons.has_undistorted_images(path):
        return "4seasons"
    if folder.find_eyes(path):
        return "folder"
    if video.find_videos(path):
        return "video"
    if single := kitti.find_single_eye(path):
        raise InputError(f"{path}: holds {single[0]} and no {single[1]}, the images of the other eye: put them there")
    above = path.absolute().parent
    if any(find(above) for find in (kitti.find_layout, euroc.find_asl_root, folder.find_eyes)):
        raise InputError(f"{path}: has one eye at most: give the folder above it, {above}")
    looked_for = "".join(
        f"\n  {format}: {module.LOOKED_FOR}"
        for format, module in zip(FORMATS[1:], (kitti, euroc, four_seasons, folder, video, bag), strict=True)
    )
    raise InputError(f"{path}: no stereo sequence of a known format; looked for{looked_for}")

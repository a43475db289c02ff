"""A stereo calibration in any of the forms that people have."""

import os
from collections.abc import Iterator
from pathlib import Path

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text
from sigmaslam.calibration_files.camera_infos import is_camera_info, read_camera_info, stereo_from_infos
from sigmaslam.calibration_files.euroc_calibration import read_sensors
from sigmaslam.calibration_files.four_seasons_calibration import UNDISTORTED, read_four_seasons
from sigmaslam.calibration_files.kalibr_calibration import is_kalibr, read_kalibr
from sigmaslam.calibration_files.kitti_calibration import GREY_PAIR, read_kitti_calibration
from sigmaslam.calibration_files.lens_models import ImageSize, UnknownImageSizeError
from sigmaslam.calibration_files.oak_calibration import read_oak
from sigmaslam.calibration_files.opencv_calibration import is_file_storage, read_opencv
from sigmaslam.calibration_files.zed_calibration import read_zed
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml

# What a folder is searched for, the first that is there; * must fit one file.
FOLDER_FILES = (
    ("calibration.yaml",),
    ("left.yaml", "right.yaml"),
    ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml"),
    ("cam0/sensor.yaml", "cam1/sensor.yaml"),
    ("cam0_sensor.yaml", "cam1_sensor.yaml"),
    # Beside a camchain.yaml, which is of 4Seasons' distorted images.
    UNDISTORTED,
    ("*camchain*.yaml",),
    ("dso/camchain.yaml",),
    ("intrinsics.yml", "extrinsics.yml"),
    ("SN*.conf",),
    ("calib*.json",),
    ("calib.txt",),
    ("calib_cam_to_cam.txt",),
)


def read_calibration(
    path: str | os.PathLike[str],
    image_size: ImageSize | None = None,
    cameras: tuple[int, int] = GREY_PAIR,
    rectified: bool = False,
) -> StereoCamera:
    """Read a calibration; its content says what it is.

    Known are the project's YAML, Kalibr's camchain, OpenCV's FileStorage (stereo_calib, ORB-SLAM2 and 3), two camera
    infos of ROS, two sensor.yaml of EuRoC, KITTI's two text forms, a ZED's SN*.conf, an OAK's JSON, 4Seasons' three.

    Args:
        path: a file, a folder with one of `FOLDER_FILES`, or two files with a comma between them, left first.
        image_size: (width, height) of the images, for files that do not give it.
        cameras: KITTI's numbers of the left and right camera.
        rectified: the images are rectified, so P of the file is their camera (ROS and OpenCV).

    Raises:
        CalibrationError: names file, key and what was expected.
        UnknownImageSizeError: the image size is needed.
    """
    paths = _files(Path(path))
    if len(paths) == len(UNDISTORTED):
        return read_four_seasons(paths)
    texts = [read_text(each, CALIBRATION_BYTES, "the calibration", CalibrationError) for each in paths]
    if len(paths) == 2:
        return _read_pair((paths[0], paths[1]), texts, image_size, rectified)
    path, text = paths[0], texts[0]
    if is_file_storage(text):
        if "T_BS" in text:
            raise CalibrationError(f"{path}: of one eye; give both, as cam0/sensor.yaml,cam1/sensor.yaml")
        return read_opencv(paths, image_size, rectified)
    if rectified:
        raise CalibrationError(f"{path}: --rectified goes with ROS camera infos and OpenCV's files, which have both")
    if path.suffix.lower() == ".conf":
        return read_zed(path, image_size)
    if path.suffix.lower() == ".json":
        return read_oak(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        return read_kitti_calibration(path, image_size, cameras)
    content = CalibrationYaml.read(path)
    if is_kalibr(content):
        return read_kalibr(content)
    if is_camera_info(content) or "T_BS" in content.entries:
        raise content.error("of one eye; give the files of both with a comma between them, left.yaml,right.yaml")
    if "camera" in content.entries:
        raise content.error("of one camera: calibrate with images of both eyes, in left/ and right/, at once")
    if not content.entries.keys() & {"left", "right", "T_left_right"}:
        raise content.error(
            f"no stereo calibration of a known form (keys: {', '.join(map(str, content.entries))}); looked for left + "
            "right + T_left_right, for cam0 + cam1 of Kalibr, and for OpenCV's matrices (all forms: "
            "sigmaslam calibrate show --help)"
        )
    return StereoCamera.from_yaml(path)


def calibrated_size(path: Path) -> ImageSize | None:
    """(width, height) of the left images that a calibration is for; None where it does not say.

    Raises:
        CalibrationError: it cannot be read.
    """
    try:
        left = read_calibration(path).left
    except UnknownImageSizeError:
        return None
    return left.width, left.height


def find_calibration(folder: Path) -> Path | None:
    """The file of the calibration in a folder, the folder itself where it has more than one; None where it has none."""
    return next((paths[0] if len(paths) == 1 else folder for paths in _candidates(folder)), None)


def _candidates(folder: Path) -> Iterator[list[Path]]:
    for names in FOLDER_FILES:
        found = [sorted(folder.glob(name)) for name in names]
        if all(len(paths) == 1 for paths in found):
            yield [paths[0] for paths in found]


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        found = next(_candidates(path), None)
        if found is None:
            looked = ", ".join(" + ".join(names) for names in FOLDER_FILES)
            raise CalibrationError(f"{path}: a folder without a calibration; looked for {looked}")
        return found
    names = [name.strip() for name in str(path).split(",")]
    if not path.exists() and len(names) in (2, len(UNDISTORTED)) and all(names):
        return [Path(name) for name in names]
    return [path]


def _read_pair(
    paths: tuple[Path, Path], texts: list[str], image_size: ImageSize | None, rectified: bool
) -> StereoCamera:
    if all("T_BS" in text for text in texts):
        return read_sensors(*paths)
    if any(is_file_storage(text) for text in texts):
        return read_opencv(paths, image_size, rectified)
    if all(is_camera_info(CalibrationYaml.read(path)) for path in paths):
        left, right = (read_camera_info(CalibrationYaml.read(path)) for path in paths)
        return stereo_from_infos(left, right, rectified)
    raise CalibrationError(
        f"{paths[0]} and {paths[1]}: not the calibrations of two eyes; looked for camera_matrix of ROS, T_BS of EuRoC, "
        "and OpenCV's intrinsics.yml,extrinsics.yml"
    )

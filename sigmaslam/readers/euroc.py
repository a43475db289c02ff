"""EuRoC's ASL folders, and the flat form with both cameras' images in one folder."""

import csv
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text, shorten
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import CameraModel, DistortionModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.readers.calibration_files import read_calibration
from sigmaslam.readers.images import ImagePairs
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.pairing import is_stamp, list_images, pair_by_stamp
from sigmaslam.readers.stereo_sequence import StereoSequence

LOOKED_FOR = (
    "folders cam0/data + cam1/data or mav0/cam0/data + mav0/cam1/data, or images/<ns>_0.* and <ns>_1.* "
    "with cam0_sensor.yaml"
)

DISTORTION_MODELS: dict[str, DistortionModel] = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "none": "none",
}


def find_asl_root(folder: Path) -> Path | None:
    """The folder that has cam0/data and cam1/data, if there is one."""
    for root in (folder, folder / "mav0"):
        if (root / "cam0" / "data").is_dir() and (root / "cam1" / "data").is_dir():
            return root
    return None


def is_flat(folder: Path) -> bool:
    """Whether this is the flat form."""
    return (folder / "images").is_dir() and (folder / "cam0_sensor.yaml").is_file()


def open_euroc(folder: Path, calibration: Path | None = None) -> StereoSequence:
    """Open a EuRoC (ASL) folder: images paired by time stamp, two sensor.yaml.

    Raises:
        InputError: the layout is not EuRoC's, or the left and right images differ by more than 10 %.
        CalibrationError: a sensor.yaml is missing or wrong.
    """
    root = find_asl_root(folder)
    if root is not None:
        left, right = (_asl_images(root / camera) for camera in ("cam0", "cam1"))
        sensors = [root / camera / "sensor.yaml" for camera in ("cam0", "cam1")]
    elif is_flat(folder):
        left, right = (_flat_images(folder / "images", eye) for eye in (0, 1))
        sensors = [folder / f"{camera}_sensor.yaml" for camera in ("cam0", "cam1")]
    else:
        raise InputError(f"{folder}: not a EuRoC folder; looked for {LOOKED_FOR}")
    files, timestamps = pair_by_stamp(left, right, folder)
    pairs = ImagePairs(files, timestamps, folder)
    if calibration is None:
        camera = read_sensors(sensors[0], sensors[1])
    else:
        camera = read_calibration(calibration, common_size(pairs.first_pair))
    return StereoSequence(pairs, camera, folder, "euroc")


def read_sensors(left: Path, right: Path) -> StereoCamera:
    """Stereo camera from two sensor.yaml; T_BS maps sensor points into the body frame.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    (left_model, T_body_left), (right_model, T_body_right) = (_read_sensor(path) for path in (left, right))
    try:
        return StereoCamera(left_model, right_model, np.linalg.inv(T_body_left) @ T_body_right)
    except (CalibrationError, np.linalg.LinAlgError) as error:
        raise CalibrationError(f"T_BS of {left} and {right}: {error}") from None


def _read_sensor(path: Path) -> tuple[CameraModel, np.ndarray]:
    content = CalibrationYaml.read(path)
    if content.text("camera_model", "pinhole") != "pinhole":
        raise content.error(f"camera_model is {shorten(repr(content.text('camera_model')))}; only pinhole is supported")
    name = content.text("distortion_model", "none")
    if name not in DISTORTION_MODELS:
        raise content.error(f"distortion_model is {shorten(repr(name))}; known are {', '.join(DISTORTION_MODELS)}")
    width, height = (round(side) for side in content.numbers("resolution", (2,)))
    fx, fy, cx, cy = content.numbers("intrinsics", (4,)).tolist()
    model = DISTORTION_MODELS[name]
    distortion = () if model == "none" else tuple(content.numbers("distortion_coefficients", (None,)).tolist())
    try:
        camera = CameraModel(width, height, fx, fy, cx, cy, 0.0, model, distortion)
    except CalibrationError as error:
        raise content.error(str(error)) from None
    if isinstance(content.entries.get("T_BS"), dict):
        return camera, content.section("T_BS").numbers("data", (16,)).reshape(4, 4)
    return camera, content.numbers("T_BS", (4, 4))


def _asl_images(camera: Path) -> dict[int, Path]:
    """Images of a camera by time stamp: the file name, or what data.csv says for that name."""
    files = list_images(camera / "data")
    if all(is_stamp(path.stem) for path in files):
        return {int(path.stem): path for path in files}
    table = camera / "data.csv"
    try:
        lines = read_text(table, TABLE_BYTES, "the time stamps").splitlines()
        rows = [row for row in csv.reader(lines) if len(row) >= 2 and not row[0].startswith("#")]
        stamps = {row[1].strip(): int(row[0]) for row in rows}
    except (InputError, ValueError, csv.Error) as error:
        raise InputError(
            f"{camera / 'data'}: names are no time stamps (such as {files[0].name}) and {table} cannot be used: "
            f"{shorten(str(error), 300)}"
        ) from None
    missing = [path.name for path in files if path.name not in stamps]
    if missing:
        raise InputError(f"{table}: no time stamp for {len(missing)} images, the first is {missing[0]}")
    return {stamps[path.name]: path for path in files}


def _flat_images(folder: Path, eye: int) -> dict[int, Path]:
    ending = f"_{eye}"
    files = [path for path in list_images(folder) if path.stem.endswith(ending)]
    stamps = {path.stem.removesuffix(ending): path for path in files}
    if not files or not all(stem.isdecimal() for stem in stamps):
        raise InputError(f"{folder}: expected images <nanoseconds>{ending}.*")
    return {int(stem): path for stem, path in stamps.items()}

"""Factory calibration of a ZED camera, SN*.conf, of its raw images."""

import configparser
import logging
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text
from sigmaslam.calibration_files.lens_models import ImageSize, camera_model, need_image_size, stereo_camera
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.se3 import rigid_motion

logger = logging.getLogger(__name__)

_RESOLUTIONS = {
    (2208, 1242): "2K",
    (1920, 1080): "FHD",
    (1280, 720): "HD",
    (672, 376): "VGA",
    (1920, 1200): "FHD1200",
    (960, 600): "SVGA",
    (3840, 2160): "4K",
    (3200, 1800): "QHDPLUS",
}
_MILLIMETRE = 1e-3


def read_zed(path: Path, image_size: ImageSize | None) -> StereoCamera:
    """Stereo camera of the resolution of the images.

    Baseline, TY and TZ are millimetres and RX, CV, RZ a rotation vector: with T = (-Baseline, TY, TZ) they take points
    of the left camera into the right one, as Stereolabs' own calibration tool writes them. The coefficients are those
    of the resolution, else those of LEFT_DISTO and RIGHT_DISTO.

    Raises:
        CalibrationError: names file, section, key and what was expected.
    """
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(read_text(path, CALIBRATION_BYTES, "the calibration", CalibrationError))
    except configparser.Error as error:
        raise CalibrationError(f"{path}: cannot read the calibration: {' '.join(str(error).split())}") from None
    # Names of sections and keys are written in capitals or not.
    content = CalibrationYaml(path, {name.upper(): dict(parser[name]) for name in parser.sections()})
    width, height = need_image_size(str(path), image_size)
    resolution = _RESOLUTIONS.get((width, height))
    if resolution is None or f"LEFT_CAM_{resolution}" not in content.entries:
        known = ", ".join(f"{w}x{h}" for (w, h), name in _RESOLUTIONS.items() if f"LEFT_CAM_{name}" in content.entries)
        raise CalibrationError(
            f"{path}: images are {width}x{height}, the calibration is for {known or 'no resolution that is known'}; "
            "use images of such a size"
        )
    models = [_camera_model(content, eye, resolution, (width, height)) for eye in ("LEFT", "RIGHT")]
    stereo, suffix = content.section("STEREO"), resolution.lower()
    rotation = np.array([stereo.number(f"{axis}_{suffix}") for axis in ("rx", "cv", "rz")])
    # TY and TZ of the resolution, else of all, else zero.
    aside = [stereo.number(f"{axis}_{suffix}", stereo.number(axis, 0.0)) for axis in ("ty", "tz")]
    translation = _MILLIMETRE * np.array([-stereo.number("baseline"), *aside])
    T_right_left = rigid_motion(cv2.Rodrigues(rotation)[0], translation)
    logger.warning(
        "%s: the calibration of raw images; what the ZED SDK exports is rectified, unless it is asked for UNRECTIFIED: "
        "then write its calibration_parameters into a YAML",
        path,
    )
    return stereo_camera(f"{path}: [STEREO]", models, T_right_left)


def _camera_model(content: CalibrationYaml, eye: str, resolution: str, size: ImageSize) -> CameraModel:
    section = lens = content.section(f"{eye}_CAM_{resolution}")
    if "k1" not in section.entries and f"{eye}_DISTO" in content.entries:
        lens = content.section(f"{eye}_DISTO")
    if "p1" in lens.entries or "k4" not in lens.entries:
        coefficients = [lens.number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        coefficients = coefficients if any(coefficients[5:]) else coefficients[:5]
        name = "radtan"
    else:
        coefficients = [lens.number(key) for key in ("k1", "k2", "k3", "k4")]
        name = "equidistant"
    intrinsics = [section.number(key) for key in ("fx", "fy", "cx", "cy")]
    return camera_model(section.where, size, intrinsics, name, coefficients, lens.prefix.rstrip("."))

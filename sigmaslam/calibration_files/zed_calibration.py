"""Factory calibration of a ZED camera, SN*.conf, of its raw images."""

import configparser
import logging
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, finite_number, read_text
from sigmaslam.calibration_files.lens_models import ImageSize, camera_model, need_image_size, stereo_camera
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera

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
    sections = {name.upper(): dict(parser[name]) for name in parser.sections()}
    width, height = need_image_size(str(path), image_size)
    resolution = _RESOLUTIONS.get((width, height))
    if resolution is None or f"LEFT_CAM_{resolution}" not in sections:
        known = ", ".join(f"{w}x{h}" for (w, h), name in _RESOLUTIONS.items() if f"LEFT_CAM_{name}" in sections)
        raise CalibrationError(
            f"{path}: images are {width}x{height}, the calibration is for {known or 'no resolution that is known'}; "
            "use images of such a size"
        )
    values = _Values(path, sections)
    models = [_camera_model(values, eye, resolution, (width, height)) for eye in ("LEFT", "RIGHT")]
    T_right_left = np.eye(4)
    rotation = np.array([values.number("STEREO", f"{axis}_{resolution}") for axis in ("RX", "CV", "RZ")])
    T_right_left[:3, :3] = cv2.Rodrigues(rotation)[0]
    T_right_left[:3, 3] = [-values.number("STEREO", "Baseline"), *(values.offset(k, resolution) for k in ("TY", "TZ"))]
    T_right_left[:3, 3] *= _MILLIMETRE
    logger.warning(
        "%s: the calibration of raw images; what the ZED SDK exports is rectified, unless it is asked for UNRECTIFIED: "
        "then write its calibration_parameters into a YAML",
        path,
    )
    return stereo_camera(f"{path}: [STEREO]", models, T_right_left)


class _Values:
    def __init__(self, path: Path, sections: dict[str, dict[str, str]]) -> None:
        self.path = path
        self.sections = sections

    def has(self, section: str, key: str) -> bool:
        return key.lower() in self.sections.get(section, {})

    def number(self, section: str, key: str) -> float:
        value = self.sections.get(section, {}).get(key.lower())
        number = np.nan if value is None else finite_number(value)
        if np.isnan(number):
            raise CalibrationError(f"{self.path}: [{section}]: key '{key}' must be a finite number, got {value}")
        return number

    def offset(self, key: str, resolution: str) -> float:
        """TY or TZ, millimetres: of the resolution, else of all, else zero."""
        for name in (f"{key}_{resolution}", key):
            if self.has("STEREO", name):
                return self.number("STEREO", name)
        return 0.0


def _camera_model(values: _Values, eye: str, resolution: str, size: ImageSize) -> CameraModel:
    section = f"{eye}_CAM_{resolution}"
    lens = section if values.has(section, "k1") else f"{eye}_DISTO"
    if values.has(lens, "p1") or not values.has(lens, "k4"):
        keys = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
        coefficients = [values.number(lens, key) if values.has(lens, key) else 0.0 for key in keys]
        coefficients = coefficients if any(coefficients[5:]) else coefficients[:5]
        name = "radtan"
    else:
        coefficients = [values.number(lens, key) for key in ("k1", "k2", "k3", "k4")]
        name = "equidistant"
    intrinsics = [values.number(section, key) for key in ("fx", "fy", "cx", "cy")]
    return camera_model(f"{values.path}: [{section}]", size, intrinsics, name, coefficients, f"[{lens}]")

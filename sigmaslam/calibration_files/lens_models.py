"""Cameras of calibration files, lenses as `CameraModel` takes them, and errors that say where.

`where` is the file, and the section, for messages; `key` is that of the lens.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, DistortionModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml

ImageSize = tuple[int, int]
DISTORTION_MODELS: dict[str, DistortionModel] = {
    **dict.fromkeys(("radial-tangential", "radtan", "plumb_bob", "rational_polynomial"), "radtan"),
    **dict.fromkeys(("equidistant", "fisheye"), "equidistant"),
    **dict.fromkeys(("none", ""), "none"),
}
# What people have and `CameraModel` has not: file name of the model, and its name in words.
UNSUPPORTED_MODELS = {
    "omni": "the omnidirectional model",
    "mei": "the omnidirectional model",
    "ds": "the double-sphere model",
    "eucm": "the extended unified model",
    "fov": "the field-of-view model",
    "atan": "the field-of-view model",
}
# After k1 k2 p1 p2 k3 k4 k5 k6 OpenCV has thin prism and tilt, which are nearly always zero.
_RADTAN_COEFFICIENTS = 8


class UnknownImageSizeError(CalibrationError):
    """A calibration file does not name the size of its images, and nothing else does."""


def need_image_size(name: str, image_size: ImageSize | None) -> ImageSize:
    """The image size that is given, (width, height).

    Raises:
        UnknownImageSizeError: none is.
    """
    if image_size is None:
        raise UnknownImageSizeError(f"{name}: does not name the size of the images; give --size WIDTHxHEIGHT")
    return image_size


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Errors of cameras and poses inside the block begin with `where`."""
    try:
        yield
    except CalibrationError as error:
        raise error if str(error).startswith(str(where)) else CalibrationError(f"{where}: {error}") from None
    except np.linalg.LinAlgError:
        raise CalibrationError(f"{where}: a matrix has no inverse; correct the numbers") from None


def camera_model(
    where: str,
    size: Sequence[float],
    intrinsics: Sequence[float],
    lens: str = "none",
    coefficients: Sequence[float] = (),
    key: str = "distortion_model",
) -> CameraModel:
    """One eye: width and height, fx, fy, cx, cy and skew, which may be left out, all pixels; lens as of `read_lens`.

    Raises:
        CalibrationError: a value is wrong, or the lens is not supported.
    """
    with naming(where):
        model, distortion = read_lens(lens, coefficients, key)
        fx, fy, cx, cy, skew = map(float, (*intrinsics, 0.0)[:5])
        return CameraModel(int(size[0]), int(size[1]), fx, fy, cx, cy, skew, model, distortion)


def intrinsics_of(K: np.ndarray) -> tuple[float, ...]:
    """fx, fy, cx, cy and skew of K (3, 3)."""
    return K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]


def read_pinhole(section: CalibrationYaml, coefficients: str) -> CameraModel:
    """One eye of Kalibr's camchain or of EuRoC's sensor.yaml, whose coefficients have another key.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    lens = section.text("distortion_model")
    values = [] if lens == "none" else section.numbers(coefficients, (None,)).tolist()
    with naming(section.where):
        _reject_unsupported(section.text("camera_model"), "camera_model")
    if section.text("camera_model") != "pinhole":
        raise section.error(f"camera_model is {section.text('camera_model')!r}; only pinhole is supported")
    size, intrinsics = section.numbers("resolution", (2,)).tolist(), section.numbers("intrinsics", (4,)).tolist()
    return camera_model(section.where, size, intrinsics, lens, values)


def stereo_camera(where: str, eyes: Sequence[CameraModel], T_right_left: np.ndarray) -> StereoCamera:
    """The pair, left first, by what takes points of the left camera into the right one, (4, 4).

    Raises:
        CalibrationError: T_right_left has no inverse, or is no pose of a right camera.
    """
    with naming(where):
        return StereoCamera(eyes[0], eyes[1], np.linalg.inv(T_right_left))


def read_lens(name: str, coefficients: Sequence[float], key: str) -> tuple[DistortionModel, tuple[float, ...]]:
    """Model and coefficients for `CameraModel`; a lens whose coefficients are all zero has the model 'none'.

    Args:
        name: of the model, as the file has it.
        coefficients: in OpenCV's order; thin prism and tilt must be zero.
        key: of the lens in the file, for messages.

    Raises:
        CalibrationError: the model is unknown or not supported, or thin prism or tilt are not zero.
    """
    _reject_unsupported(name, key)
    if name not in DISTORTION_MODELS:
        known = ", ".join(model for model in DISTORTION_MODELS if model)
        raise CalibrationError(f"{key} is {name!r}; known are {known}")
    model = DISTORTION_MODELS[name]
    values = [float(value) for value in coefficients]
    if model == "none" or (model == "radtan" and not any(values)):
        return "none", ()
    while model == "radtan" and len(values) > _RADTAN_COEFFICIENTS and values[-1] == 0.0:
        values.pop()
    if model == "radtan" and len(values) > _RADTAN_COEFFICIENTS:
        raise CalibrationError(
            f"{key}: thin prism and tilt ({', '.join(f'{value:g}' for value in values[_RADTAN_COEFFICIENTS:])}) are "
            "not supported: calibrate again with k1 k2 p1 p2 k3 k4 k5 k6 alone"
        )
    return model, tuple(values)


def _reject_unsupported(name: str, key: str) -> None:
    """Refuse a camera or lens model that is known and not supported."""
    if name.lower() in UNSUPPORTED_MODELS:
        raise CalibrationError(
            f"{key} is {name!r}, {UNSUPPORTED_MODELS[name.lower()]}, which is not supported: calibrate again as "
            "pinhole with radtan, or with equidistant for a fisheye lens"
        )

"""Names and coefficients of lens models in calibration files, as `CameraModel` takes them."""

from collections.abc import Sequence

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import DistortionModel

DISTORTION_MODELS: dict[str, DistortionModel] = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "none": "none",
    "": "none",
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


def reject_unsupported(name: str, where: str) -> None:
    """Refuse a camera or lens model that is known and not supported.

    Args:
        name: as the file has it.
        where: file and key, for the message.

    Raises:
        CalibrationError: says which model it is, and what to do.
    """
    if name.lower() in UNSUPPORTED_MODELS:
        raise CalibrationError(
            f"{where} is {name!r}, {UNSUPPORTED_MODELS[name.lower()]}, which is not supported: calibrate again as "
            "pinhole with radtan, or with equidistant for a fisheye lens"
        )


def read_lens(name: str, coefficients: Sequence[float], where: str) -> tuple[DistortionModel, tuple[float, ...]]:
    """Model and coefficients for `CameraModel`; a lens whose coefficients are all zero has the model 'none'.

    Args:
        name: of the model, as the file has it.
        coefficients: in OpenCV's order; thin prism and tilt must be zero.
        where: file and key, for messages.

    Raises:
        CalibrationError: the model is unknown or not supported, or thin prism or tilt are not zero.
    """
    reject_unsupported(name, where)
    if name not in DISTORTION_MODELS:
        known = ", ".join(model for model in DISTORTION_MODELS if model)
        raise CalibrationError(f"{where} is {name!r}; known are {known}")
    model = DISTORTION_MODELS[name]
    values = [float(value) for value in coefficients]
    if model == "none" or (model == "radtan" and not any(values)):
        return "none", ()
    while model == "radtan" and len(values) > _RADTAN_COEFFICIENTS and values[-1] == 0.0:
        values.pop()
    if model == "radtan" and len(values) > _RADTAN_COEFFICIENTS:
        raise CalibrationError(
            f"{where}: thin prism and tilt ({', '.join(f'{value:g}' for value in values[_RADTAN_COEFFICIENTS:])}) are "
            "not supported: calibrate again with k1 k2 p1 p2 k3 k4 k5 k6 alone"
        )
    return model, tuple(values)

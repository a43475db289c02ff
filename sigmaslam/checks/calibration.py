"""What a calibration shows without images: lengths, principal points and focal lengths that no rig has."""

import numpy as np

from sigmaslam.checks.finding import Finding
from sigmaslam.geometry.camera import CameraModel, StereoCamera

# From the eyes of an endoscope, 4 mm apart, to the roof of a lorry, metres.
MIN_BASELINE, MAX_BASELINE = 0.003, 3.0
_LENGTH_UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2), ("micrometres", 1e-6))
# How far from the middle a principal point may be, as a share of width and height.
MAX_OFF_CENTRE = 0.2
# Sizes of the images that intrinsics may be of, relative to these.
_SIZES = (4.0, 3.0, 2.0, 1.5, 2.0 / 3.0, 0.5, 1.0 / 3.0, 0.25)
_SIZE_TOLERANCE = 0.1
# Horizontal fields of view, degrees: a long tele lens, and what a plane image can hold.
_MIN_VIEW, _MAX_VIEW = 5.0, 150.0
# Pixels of cameras are square to a per cent, those of analogue video and anamorphic images to a tenth.
_MAX_ASPECT = 1.15


def check_calibration(camera: StereoCamera) -> list[Finding]:
    """Findings from the calibration alone."""
    by_eye = [
        [check(eye, model) for eye, model in (("left", camera.left), ("right", camera.right))]
        for check in (_check_centre, _check_focal)
    ]
    worst = [next((each for each in both if each.severity != "ok"), both[0]) for both in by_eye]
    return [_check_baseline(camera.baseline), *worst]


def _check_baseline(baseline: float) -> Finding:
    if MIN_BASELINE <= baseline <= MAX_BASELINE:
        return Finding("baseline", "ok", f"baseline {baseline:.4g} m", baseline)
    likely = [
        f"{name} ({baseline * unit:.3g} m)"
        for name, unit in _LENGTH_UNITS
        if MIN_BASELINE <= baseline * unit <= MAX_BASELINE
    ]
    guess = f"is it in {' or '.join(likely)}? Give" if likely else "give"
    message = (
        f"baseline {baseline:.4g} m is outside {MIN_BASELINE:g} to {MAX_BASELINE:g} m: {guess} T_left_right (or P, or "
        "OpenCV's T, which has the unit of the board's squares) in metres, as poses have its scale"
    )
    return Finding("baseline", "warning", message, baseline)


def _off_centre(model: CameraModel, cx: float, cy: float) -> float:
    """Distance of a principal point from the middle, the larger of the shares of width and height."""
    return max(abs(cx - 0.5 * (model.width - 1)) / model.width, abs(cy - 0.5 * (model.height - 1)) / model.height)


def _check_centre(eye: str, model: CameraModel) -> Finding:
    off = _off_centre(model, model.cx, model.cy)
    where = f"principal point ({model.cx:.1f}, {model.cy:.1f}) of the {eye} camera"
    if off <= MAX_OFF_CENTRE:
        return Finding("principal point", "ok", f"{where} is {100 * off:.0f} % of the image from its middle", off)
    size = f"{model.width}x{model.height}"
    cure = "give the calibration of these images"
    if _off_centre(model, model.cy, model.cx) <= MAX_OFF_CENTRE:
        cure = "cx and cy are exchanged: exchange them"
    else:
        for scale in _SIZES:
            if _off_centre(model, model.cx / scale, model.cy / scale) <= _SIZE_TOLERANCE:
                cure = (
                    f"these look like intrinsics of images of {scale * model.width:.0f}x{scale * model.height:.0f}: "
                    f"multiply fx, fy, cx, cy by {1.0 / scale:.3g}"
                )
                break
    message = f"{where} is {100 * off:.0f} % of the image from its middle ({size}): {cure}"
    return Finding("principal point", "warning", message, off)


def _check_focal(eye: str, model: CameraModel) -> Finding:
    view = float(np.degrees(2.0 * np.arctan(0.5 * model.width / model.fx)))
    aspect = max(model.fx / model.fy, model.fy / model.fx)
    shown = f"fx {model.fx:.1f}, fy {model.fy:.1f} of the {eye} camera"
    if aspect > _MAX_ASPECT:
        message = (
            f"{shown} differ by {100 * (aspect - 1):.0f} %: are pixels not square? Give both in pixels of these images"
        )
        return Finding("focal length", "warning", message, aspect)
    # Lenses that are described as equidistant may see more than a plane image holds.
    if view < _MIN_VIEW or (view > _MAX_VIEW and model.distortion_model != "equidistant"):
        message = (
            f"{shown} are a field of view of {view:.3g} degrees at {model.width} px: give them in pixels, not in "
            "millimetres or shares of the width"
        )
        return Finding("focal length", "warning", message, view)
    return Finding("focal length", "ok", f"{shown} are a field of view of {view:.0f} degrees without distortion", view)

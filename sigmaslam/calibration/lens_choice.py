"""A lens model that describes the whole image."""

from collections.abc import Sequence

import numpy as np

from sigmaslam.calibration.board_bundle import Rig
from sigmaslam.calibration.boards import DetectedCorners
from sigmaslam.calibration.calibrate import BoardCalibration, calibrate
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel

USUAL_LENS = "radtan5"
# One coefficient fewer, and a polynomial of the angle, which goes on growing where one of the tangent turns back. With
# eight coefficients what the border of the image shows is left open.
OTHER_LENSES = ("radtan4", "equidistant")


def calibrate_whole_images(
    names: Sequence[str],
    views: Sequence[Sequence[DetectedCorners]],
    points: np.ndarray,
    sizes: Sequence[tuple[int, int]],
) -> BoardCalibration:
    """As `calibrate` with `USUAL_LENS`; where that folds in an image, with the best of those that do not.

    The best has the least rms of all corners, those left out included. If all fold, it is the usual one.
    """
    usual = calibrate(names, views, points, sizes, USUAL_LENS)
    if not _any_folds(usual.rig):
        return usual
    others = []
    for lens in OTHER_LENSES:
        try:
            result = calibrate(names, views, points, sizes, lens)
        except CalibrationError:
            continue
        if not _any_folds(result.rig):
            others.append(result)
    return min(others, key=lambda result: result.rms_of_all, default=usual)


def folds(eye: CameraModel) -> bool:
    """Whether pixels at the image's border have no ray."""
    u, v = np.linspace(0.0, eye.width - 1.0, 33), np.linspace(0.0, eye.height - 1.0, 25)
    border = [(x, y) for x in u.tolist() for y in (0.0, eye.height - 1.0)]
    border += [(x, y) for x in (0.0, eye.width - 1.0) for y in v.tolist()]
    return not bool(np.all(np.isfinite(eye.unproject(np.array(border)))))


def _any_folds(rig: Rig) -> bool:
    return any(folds(eye) for eye in rig.eyes)

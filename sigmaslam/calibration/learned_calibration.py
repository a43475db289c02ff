"""What a run learned of its calibration, as a calibration for the next one."""

from dataclasses import replace

import cv2
import numpy as np

from sigmaslam.calibration.tracker_covariance import nearest_errors
from sigmaslam.estimation.calibration_errors import ERRORS
from sigmaslam.geometry.calibration_covariance import CalibrationCovariance
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.slam.estimate import CalibrationEstimate

_LENSES = "lens", "lenses"
_ROUNDS = 3  # of fixed points; one leaves half of what a barrel does, two 4 % at k1 0.08 off


def learned_calibration(camera: StereoCamera, learned: CalibrationEstimate, focal_length: float) -> StereoCamera:
    """The pair without its disparity offset, which is taken for one of the right principal point, as are bumped rows.

    Where the offset was so large that the baseline must have made up for it, that is corrected, too, and so is what is
    wrong by the evidence, in the right camera. Other errors that were estimated are not: which parameter they belong to
    is not known.

    Args:
        focal_length: of the rectified pair, pixels.
    """
    shares = {name: value for name, (_, value, _) in learned.causes.items()}
    zoom, yaw = 1.0 - shares.get("zoom", 0.0), shares.get("yaw", 0.0)
    # A turn about the vertical is part of the offset.
    offset = learned.disparity_offset / focal_length - yaw
    right = replace(camera.right, fx=zoom * camera.right.fx, fy=zoom * camera.right.fy)
    right = replace(right, cx=right.cx - offset * right.fx, cy=right.cy + learned.raised)
    is_radial = all(eye.distortion_model != "equidistant" for eye in (camera.left, camera.right))
    both, right_less = _coefficients(camera, [shares.get(name, 0.0) for name in _LENSES]) if is_radial else (0.0, 0.0)
    left, right = _bent(camera.left, both), _bent(right, both - right_less)
    corrected = {name: each for name, each in learned.causes.items() if is_radial or name not in _LENSES}
    variances = {name: sigma**2 for name, (_, _, sigma) in corrected.items()}
    variances["offset"] = (learned.disparity_offset_sigma / focal_length) ** 2
    T_left_right = camera.T_left_right.copy()
    T_left_right[:3, :3] = T_left_right[:3, :3] @ cv2.Rodrigues(np.array([0.0, yaw, 0.0]))[0]
    if "baseline" in learned.errors:
        baseline, sigma = learned.errors["baseline"]
        T_left_right[:3, 3] *= 1.0 + baseline
        variances["baseline"] = sigma**2
    known = camera.covariance or CalibrationCovariance((), np.zeros((0, 0)))
    kept = [k for k, name in enumerate(known.names) if name not in variances]
    names = (*(known.names[k] for k in kept), *variances)
    matrix = np.diag(np.r_[np.zeros(len(kept)), list(variances.values())])
    matrix[: len(kept), : len(kept)] = known.matrix[np.ix_(kept, kept)]
    return replace(
        camera, left=left, right=right, T_left_right=T_left_right, covariance=CalibrationCovariance(names, matrix)
    )


def _coefficients(camera: StereoCamera, shares: list[float]) -> tuple[float, float]:
    """By how much k1 of both lenses is too small, and of the right one too large besides, by the tracker's errors.

    Rays at the edge of a barrel move by it three times as much as in the middle.

    Args:
        shares: of the focal length, in the order of `_LENSES`.
    """
    rows, wanted = [ERRORS.index(name) for name in _LENSES], np.array(shares)
    found, k1 = wanted, wanted
    for _ in range(_ROUNDS):
        k1 = np.divide(k1 * wanted, found, out=np.zeros(2), where=wanted != 0.0)
        bent = replace(camera, left=_bent(camera.left, k1[0]), right=_bent(camera.right, k1[0] - k1[1]))
        found = nearest_errors(camera, bent)[rows] / StereoRectifier(camera).rectified.fx
    return float(k1[0]), float(k1[1])


def _bent(eye: CameraModel, k1: float) -> CameraModel:
    """The camera with so much more radial distortion."""
    if k1 == 0.0:
        return eye
    first, *others = eye.distortion or (0.0,) * 4
    return replace(eye, distortion_model="radtan", distortion=(first + k1, *others))

"""What a run learned of its calibration, as a calibration for the next one."""

from dataclasses import replace

import cv2
import numpy as np

from sigmaslam.geometry.calibration_covariance import CalibrationCovariance
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.slam.estimate import CalibrationEstimate


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
    both = shares.get("lens", 0.0)
    left, right = _bent(camera.left, both), _bent(right, both - shares.get("lenses", 0.0))
    left_alone = ("lens", "lenses") if right.distortion_model == "equidistant" else ()
    variances = {name: sigma**2 for name, (_, _, sigma) in learned.causes.items() if name not in left_alone}
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


def _bent(eye: CameraModel, k1: float) -> CameraModel:
    """The camera with so much more radial distortion; as it is if it has another kind."""
    if k1 == 0.0 or eye.distortion_model == "equidistant":
        return eye
    first, *others = eye.distortion or (0.0,) * 4
    return replace(eye, distortion_model="radtan", distortion=(first + k1, *others))

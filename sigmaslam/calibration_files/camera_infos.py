"""Two ROS camera infos, of messages or of files, as a stereo camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam.calibration_files.lens_models import camera_model, intrinsics_of, naming
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.se3 import rigid_motion


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What ROS says of one eye of a stereo pair.

    Attributes:
        name: file or topic, for messages.
        width, height: image size, pixels.
        lens: name of the distortion model.
        D: coefficients of the raw image.
        K: (3, 3) of the raw image.
        R: (3, 3) rotation from the raw to the rectified camera.
        P: (3, 4) projection of the rectified camera, K' [I | t] with t of the left eye in this one.
    """

    name: str
    width: int
    height: int
    lens: str
    D: Sequence[float]
    K: np.ndarray
    R: np.ndarray
    P: np.ndarray


def right_position(P_left: np.ndarray, P_right: np.ndarray) -> np.ndarray:
    """Position of the right camera in the left one, (3,) metres, from (3, 4) projections of parallel cameras."""
    left, right = (np.linalg.solve(P[:, :3], P[:, 3]) for P in (P_left, P_right))
    return np.asarray(left - right)


def stereo_from_infos(left: CameraInfo, right: CameraInfo, rectified: bool) -> StereoCamera:
    """Stereo camera of rectified images (pinhole cameras of P) or of raw ones.

    Raw images have K and D, and R and P say how the two are placed: x_rectified = R x, and P = K' [I | t].

    Raises:
        CalibrationError: an eye is not calibrated, there is no baseline, or a lens model is unknown.
    """
    infos = (left, right)
    for info in infos:
        for key, matrix in (("P", info.P), *((("K", info.K), ("R", info.R)) if not rectified else ())):
            if not np.all(np.isfinite(matrix)) or np.linalg.det(matrix[:, :3]) == 0.0:
                raise CalibrationError(f"{info.name}: not calibrated, {key} is {matrix.tolist()}; give --calibration")
    T_left_right = rigid_motion(np.eye(3), right_position(left.P, right.P))
    if not np.any(T_left_right[:3, 3]):
        raise CalibrationError(
            f"{right.name}: no baseline (P[0, 3] is 0): the eyes were calibrated one by one; calibrate them as a "
            "stereo pair, or give --calibration"
        )
    if not rectified:
        R_left, R_right = (rigid_motion(info.R, np.zeros(3)) for info in infos)
        T_left_right = R_left.T @ T_left_right @ R_right
    eyes = [
        camera_model(info.name, (info.width, info.height), intrinsics_of(info.P))
        if rectified
        else camera_model(info.name, (info.width, info.height), intrinsics_of(info.K), info.lens, info.D)
        for info in infos
    ]
    with naming(f"{left.name} and {right.name}"):
        return StereoCamera(eyes[0], eyes[1], T_left_right)


def is_camera_info(content: CalibrationYaml) -> bool:
    """Whether a YAML file is what ROS's camera_calibration writes for one eye."""
    return "camera_matrix" in content.entries and "image_width" in content.entries


def read_camera_info(content: CalibrationYaml) -> CameraInfo:
    """A file of ROS's camera_calibration (image_width, camera_matrix, ..., projection_matrix).

    Raises:
        CalibrationError: a key is missing or wrong.
    """
    return CameraInfo(
        name=str(content.path),
        width=content.integer("image_width"),
        height=content.integer("image_height"),
        lens=content.text("distortion_model", "plumb_bob"),
        D=content.section("distortion_coefficients").numbers("data", (None,)).tolist(),
        K=content.section("camera_matrix").numbers("data", (9,)).reshape(3, 3),
        R=content.section("rectification_matrix").numbers("data", (9,)).reshape(3, 3),
        P=content.section("projection_matrix").numbers("data", (12,)).reshape(3, 4),
    )

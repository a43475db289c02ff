"""A calibration of an inertial sensor in words, and as Kalibr's camchain-imucam.yaml."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.calibration.board_bundle import pose_errors
from sigmaslam.calibration.calibrate import BoardCalibration
from sigmaslam.calibration.imu_calibration import NAMES, CameraPath, ImuCalibration
from sigmaslam.calibration_files.kalibr_calibration import write_kalibr
from sigmaslam.errors import InputError
from sigmaslam.estimation.gaussian import matrix_root
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import rotation_log, se3_inverse
from sigmaslam.readers.pairing import stamps_of


def image_times(names: Sequence[str]) -> np.ndarray:
    """(N,) seconds of images that are named by their time since 1970, as those of `board_images` of both eyes.

    Raises:
        InputError: a name is no time.
    """
    stamps = stamps_of([Path(name.split(" + ")[0]).stem for name in names])
    if stamps is None:
        raise InputError(f"{names[0]}, ...: with --imu all names are times in nanoseconds, as in EuRoC's cam0/data")
    return np.array([stamp / 1e9 for stamp in stamps])


def board_path(result: BoardCalibration) -> CameraPath:
    """The left camera's path before the board."""
    times = image_times(result.names)
    order = np.argsort(times)
    own, by_rig = pose_errors(result.bundle, result.corners)
    common = by_rig @ matrix_root(result.covariance)
    return CameraPath(times, se3_inverse(result.bundle.poses), result.sigma**2 * own, common).select(order)


def write_imu_calibration(
    path: Path, eyes: Sequence[CameraModel], T_left_right: np.ndarray, result: ImuCalibration
) -> None:
    """Writes what Kalibr and `--imu` read, with the covariance and the biases beside.

    Raises:
        InputError: the folder cannot be written.
    """
    more: dict[str, Any] = {
        "imu_calibration": {
            "names": list(NAMES),
            "sigmas": np.sqrt(np.diag(result.covariance)).tolist(),
            "covariance": result.covariance.tolist(),
            "gyro_bias": result.biases[:3].tolist(),
            "accelerometer_bias": result.biases[3:].tolist(),
            "bias_sigmas": np.sqrt(np.diag(result.bias_covariance)).tolist(),
            "images": result.images,
        }
    }
    write_kalibr(path, eyes, T_left_right, result.sensor, more)


def describe_imu_calibration(result: ImuCalibration) -> str:
    """Delay, mounting, biases and noise with sigmas, a line each."""
    sigmas, bias_sigmas = (np.sqrt(np.diag(each)) for each in (result.covariance, result.bias_covariance))
    T = result.sensor.T_left_imu
    poses, gyro, accel = result.scales
    doubt = "\nforces    hardly follow the motion: are they in m/s^2, 9.81 upwards at rest, in the gyro's axes?"
    return "\n".join(
        [
            f"imu       {result.images} poses; timeshift_cam_imu {1e3 * result.sensor.time_shift:+.3f} ± "
            f"{1e3 * sigmas[0]:.3f} ms",
            f"rotation  T_cam_imu {_listed(np.degrees(rotation_log(T[:3, :3])), np.degrees(sigmas[1:4]), 3)} degrees",
            f"lever arm {_listed(1e3 * T[:3, 3], 1e3 * sigmas[4:], 2)} mm: the sensor in the left camera's frame",
            f"biases    gyro {_listed(result.biases[:3], bias_sigmas[:3], 5)} rad/s, accelerometer "
            f"{_listed(result.biases[3:], bias_sigmas[3:], 4)} m/s^2, at the end",
            f"gravity   is known to {np.degrees(result.gravity_sigma):.2f} degrees",
            f"noise     gyro {gyro:.1f} and accelerometer {accel:.1f} times their densities, poses {poses:.2f} times "
            f"as was said{doubt if result.is_foreign else ''}",
        ]
    )


def _listed(values: np.ndarray, sigmas: np.ndarray, digits: int) -> str:
    parts = [f"{value:.{digits}f} ± {sigma:.{digits}f}" for value, sigma in zip(values, sigmas, strict=True)]
    return f"({', '.join(parts)})"

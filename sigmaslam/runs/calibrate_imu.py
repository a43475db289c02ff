"""Calibration of an inertial sensor by the path of a run of `sigmaslam track`."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sigmaslam.calibration.imu_calibration import CameraPath, ImuCalibration, calibrate_imu
from sigmaslam.errors import InputError
from sigmaslam.estimation.inertial_turns import SHARED_ERRORS
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.readers.trajectory_files import read_covariances
from sigmaslam.run_record.frame_table import predicted_poses
from sigmaslam.run_record.recorded_run import read_run
from sigmaslam.run_record.run_folder import FINAL_COVARIANCE, RUN_NAME, camera_of, check_has_trajectory


def calibrate_imu_by_run(
    folder: Path, recording: InertialRecording, done: Callable[[], object]
) -> tuple[ImuCalibration, StereoCamera]:
    """Calibrates a sensor that was recorded beside the images of a run; that run had best not used it (--imu off).

    Args:
        done: as of `calibrate_imu`.
    Returns:
        The calibration, and the run's camera.
    Raises:
        InputError: it is no run, has no poses after the fact, or was tracked with this sensor.
        CalibrationError: as of `calibrate_imu`.
    """
    check_has_trajectory(folder)
    run = read_run(folder)
    if run.final is None:
        raise InputError(f"{folder}: holds no trajectory after the fact: track anew, without --resume and --location")
    if "imu" in run.entries:
        raise InputError(f"{folder}: its poses know the inertial sensor already: track anew with --imu off")
    covariances = read_covariances(folder / FINAL_COVARIANCE, len(run.final))
    seen = ~predicted_poses(run.frames, run.final.timestamps)
    # Covariances are those in the world, most of which neighbours share: what is a frame's own is alike in all.
    own = np.tile(covariances.mean(axis=0), (int(seen.sum()), 1, 1))
    path = CameraPath(run.final.timestamps[seen], run.final.poses[seen], own, np.zeros((len(own), 6, 0)))
    result = calibrate_imu(path, recording.samples, recording.sensor, SHARED_ERRORS, done)
    return result, camera_of(folder / RUN_NAME, run.entries["calibration"])

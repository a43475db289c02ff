"""The motion model of a tracker, by the sensor that it has."""

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.odometry_sensor import OdometrySensor


def build_motion(
    backend: str, imu: InertialSensor | None, odometry: OdometrySensor | None, T_camera_left: np.ndarray
) -> MotionFilter:
    """The motion of a rectified camera by the sensors beside it; where there is none, constant velocity.

    Args:
        backend: "onnx" or "torch".
        imu, odometry: beside the left camera.
        T_camera_left: (4, 4) takes points of the left camera into the rectified one.
    """
    # Imported where there is one: together they take a tenth of the time in which a tracker is imported.
    if imu is not None and imu.has_accelerometer:
        from sigmaslam.estimation.inertial_motion import InertialMotion
        from sigmaslam.estimation.wheel_speed import WheelSpeed

        wheels = None if odometry is None else WheelSpeed(odometry, T_camera_left @ odometry.T_left_base)
        return InertialMotion(backend, imu, T_camera_left @ imu.T_left_imu, wheels)
    if odometry is not None:
        from sigmaslam.estimation.odometry_motion import OdometryMotion

        return OdometryMotion(backend, odometry, T_camera_left @ odometry.T_left_base)
    if imu is not None:
        from sigmaslam.estimation.gyro_motion import GyroMotion

        return GyroMotion(backend, imu, T_camera_left @ imu.T_left_imu)
    return MotionFilter(backend)

"""Wheels, or whatever measures the velocity of a vehicle beside the cameras."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.table import Table


@dataclass(frozen=True, slots=True)
class OdometrySensor:
    """Where the velocity is measured, and by which clock; its noise is learned.

    Attributes:
        T_left_base: (4, 4) takes points of the vehicle's frame into the left camera.
        time_shift: clock of the odometry minus that of the camera, seconds.
        is_planar: roll and pitch rate are not measured; they are zero in the mean.
    """

    T_left_base: np.ndarray
    time_shift: float = 0.0
    is_planar: bool = True


@dataclass(frozen=True, slots=True)
class OdometrySamples(Table):
    """What was measured, in the order of time, in axes forward, left, up of the vehicle (ROS REP 103).

    Attributes:
        timestamp: (N,) seconds, of the odometry's clock.
        angular: (N, 3) angular velocity, rad/s.
        linear: (N, 3) velocity of the frame's origin, m/s.
    """

    timestamp: np.ndarray
    angular: np.ndarray
    linear: np.ndarray

"""What is assumed of the motion, by the depth of the scene."""

from __future__ import annotations

import numpy as np

from sigmaslam.slam.config import TrackerConfig


def densities(config: TrackerConfig, depth: float) -> np.ndarray:
    """(2,) power spectral densities of the accelerations in a scene of that depth (metres): m^2/s^3 and rad^2/s^3."""
    return np.array([(config.acceleration * depth) ** 2, config.angular_acceleration**2])


def initial_twist_sigma(config: TrackerConfig, depth: float) -> np.ndarray:
    """(6,) standard deviations of a velocity that nothing is known of, m/s and rad/s."""
    return np.repeat([config.start_speed * depth, config.start_turn], 3)

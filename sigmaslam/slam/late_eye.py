"""A right eye that takes its images later than the left one."""

from dataclasses import replace

import numpy as np

from sigmaslam.frontend import StereoView
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, transform_points

# What is farther than where its disparity is this moves as if it were there, pixels.
_LEAST_DISPARITY = 0.5
# Where a point was depends on its disparity there: each step leaves a quarter of the error at most, as it passes a car.
_STEPS = 5


def at_one_moment(view: StereoView, camera: RectifiedStereo, way: np.ndarray) -> StereoView:
    """A view as if both its images were of the moment of the left one, by the way (6,) of the camera in between."""
    T_late_now, disparity = se3_exp(-way), view.disparity
    for _ in range(_STEPS):
        now = np.column_stack([view.features.keypoints, np.fmax(disparity, _LEAST_DISPARITY)])
        late = camera.project(transform_points(T_late_now, camera.triangulate(now)))
        # By so much the right image moves to the left until it is taken.
        disparity = view.disparity - (now[:, 0] - now[:, 2] - late[:, 0] + late[:, 2])
    return replace(view, disparity=disparity)

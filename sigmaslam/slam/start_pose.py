"""Where a tracker starts that goes on in the world of an earlier run."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.geometry.se3 import se3_inverse, turn_covariance


@dataclass(frozen=True, slots=True)
class StartPose:
    """Pose of the first keyframe.

    Attributes:
        T_world_camera: (4, 4) of the left camera.
        covariance: (6, 6) of it in the camera's own frame, translation (metres) before rotation (radians).
    """

    T_world_camera: np.ndarray
    covariance: np.ndarray

    def of_rectified(self, T_rectified_left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same of the rectified camera, in a world that is turned like it.

        Args:
            T_rectified_left: (4, 4) takes points of the left camera into the rectified one.
        Returns:
            Pose (4, 4), and its covariance (6, 6), perturbed from the left in the world.
        """
        pose = T_rectified_left @ self.T_world_camera @ se3_inverse(T_rectified_left)
        return pose, turn_covariance(pose @ T_rectified_left, self.covariance)

"""Points that keyframes see, for views of a run that goes on; the map itself is known in the end."""

import numpy as np

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.live.frame_sink import TrackedFrame

# Points are shown whose disparity is so many times its standard deviation.
_CERTAIN = 10.0


class KeyframePoints:
    """Triangulates what each keyframe sees and no keyframe before it has shown.

    Args:
        camera: of the raw images.

    Attributes:
        T_left_rectified: (4, 4) takes points of the rectified left camera into the left one.
    """

    def __init__(self, camera: StereoCamera) -> None:
        rectifier = StereoRectifier(camera)
        self.camera = rectifier.rectified
        self.T_left_rectified = se3_inverse(rectifier.T_rectified_left)
        self._shown: set[int] = set()

    def add(self, frame: TrackedFrame) -> tuple[np.ndarray, np.ndarray]:
        """New points of a frame.

        Returns:
            (N, 3) in the world, metres, and (N,) uint8 their grey values; none where it is no keyframe.
        """
        estimate = frame.result.camera
        if estimate.tracks is None or frame.seen is None or not estimate.has_pose:
            return np.zeros((0, 3)), np.zeros(0, np.uint8)
        tracks = estimate.tracks
        disparity = tracks.measurement[:, 2] - estimate.calibration.disparity_offset
        certain = disparity > _CERTAIN * np.sqrt(tracks.covariance[:, 2, 2])  # false where it is NaN
        new = np.array([number not in self._shown for number in tracks.landmark_id.tolist()], bool)
        rows = np.flatnonzero(certain & new & (disparity > 0.0))
        self._shown.update(tracks.landmark_id[rows].tolist())
        pixels = tracks.measurement[rows, :2]
        points = self.camera.triangulate(np.column_stack([pixels, disparity[rows]]))
        u, v = np.clip(np.rint(pixels).astype(np.int64), 0, np.array(frame.seen.left.shape[::-1]) - 1).T
        return transform_points(estimate.T_world_camera @ self.T_left_rectified, points), frame.seen.left[v, u]

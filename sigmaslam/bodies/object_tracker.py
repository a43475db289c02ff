"""The reverse job (9.5.1, figure 9.8): a stereo camera at rest follows one rigid body that moves.

In the body's frame it is the camera that moves, so the tracker is the same; the scene is the outlier. What is added is
where landmarks may be: on the body (`BodyAdmission`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from sigmaslam.bodies.body_admission import BodyAdmission
from sigmaslam.errors import InputError
from sigmaslam.frontend import Frontend, build_frontend
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import rigid_motion, se3_inverse, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.inference.networks import WeightsFolder
from sigmaslam.slam.argument_checks import check_region, check_tracker_arguments
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.matched_frame import MatchedFrame
from sigmaslam.slam.point_map import PointMap
from sigmaslam.slam.relative_poses import RelativePoses
from sigmaslam.slam.tracker import StereoTracker

# Hands move things faster than cameras are carried.
OBJECT_CONFIG = TrackerConfig(acceleration=1.0, angular_acceleration=3.0, start_turn=3.0)
# Of the body's size: points so far outside the box about its own ones are not the body's.
_SLACK = 0.1


@dataclass(frozen=True, slots=True)
class ObjectEstimate:
    """Result for one stereo pair.

    Attributes:
        camera: the camera's estimate in the body's frame, which is its world.
    """

    camera: Estimate

    @property
    def timestamp(self) -> float:
        """Seconds."""
        return self.camera.timestamp

    @property
    def status(self) -> str:
        """As of `Estimate`."""
        return self.camera.status

    @property
    def T_camera_object(self) -> np.ndarray:  # noqa: N802
        """(4, 4) pose of the body in the left camera's frame."""
        return se3_inverse(self.camera.T_world_camera)

    @property
    def object_covariance(self) -> np.ndarray:
        """(6, 6) of `T_camera_object` in the body's own frame, translation (metres) before rotation (radians)."""
        return self._on_body(self.camera.covariance)

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) what is tracked: `T_camera_object`."""
        return self.T_camera_object

    @property
    def pose_covariance(self) -> np.ndarray:
        """(6, 6) of `pose` in its own frame."""
        return self.object_covariance

    @property
    def pose_matching_covariance(self) -> np.ndarray:
        """(6, 6) the part of `pose_covariance` that comes from matches and motion."""
        return self._on_body(self.camera.matching_covariance)

    def _on_body(self, covariance: np.ndarray) -> np.ndarray:
        """A covariance (6, 6) in the camera's frame as that of `T_camera_object` in the body's own frame."""
        if not self.camera.has_pose:
            return covariance
        covariance = turn_covariance(self.camera.T_world_camera, covariance)
        return np.asarray(0.5 * (covariance + covariance.T))

    def map_camera(self, change: Callable[[Estimate], Estimate]) -> Self:
        """The result with another camera estimate."""
        return replace(self, camera=change(self.camera))


class ObjectTracker:
    """Follows one rigid body before a stereo camera at rest.

    The body's frame has the axes of the left camera in the first frame; its origin is the median of the body's stereo
    points there (of the inner half of the region).

    Example:
        tracker = ObjectTracker(camera, read_region("400,200,300,250", width, height))
        estimate = tracker.step(left, right, timestamp)
        estimate.T_camera_object, estimate.object_covariance

    Args:
        camera: calibration of the raw images.
        region: (H, W) bool, where the body is in the first raw left image; background inside does little harm.
        frontend, backend, threads, provider, weights: of `StereoTracker`.
        config: likewise; by default `OBJECT_CONFIG`, with more acceleration.
    Raises:
        InputError: an argument is of another type or size, or nothing is in the region.
    """

    def __init__(
        self,
        camera: StereoCamera,
        region: np.ndarray,
        frontend: Frontend | str = "learned",
        backend: str = "onnx",
        config: TrackerConfig | None = None,
        threads: int = 2,
        provider: str = "cpu",
        weights: WeightsFolder = None,
    ) -> None:
        check_tracker_arguments(camera, frontend, backend, config, threads, weights)
        check_region(region, camera)
        self.config = config = config or OBJECT_CONFIG
        rectifier = StereoRectifier(camera)
        self._T_left_rectified = se3_inverse(rectifier.T_rectified_left)
        if isinstance(frontend, str):
            frontend = build_frontend(frontend, config.max_keypoints, backend, threads, provider, weights)
        raw = region.astype(np.uint8) * 255
        rectified_region = rectifier.rectify(raw, raw)[0] > 127
        self._body = BodyAdmission(rectifier.rectified, rectified_region, frontend, config)
        self._tracker = StereoTracker(camera, frontend, backend, config, self._body, threads)
        # What each frame with a pose before the body moved on its own adds to its covariance.
        self._unseen_motion: list[np.ndarray] = []

    @property
    def origin(self) -> np.ndarray:
        """(3,) of the body's frame in the first left camera's, metres."""
        return np.asarray((self._T_left_rectified @ self._body.T_camera_body)[:3, 3])

    def step(
        self, left: np.ndarray, right: np.ndarray, timestamp: float, mask: np.ndarray | None = None
    ) -> ObjectEstimate:
        """Takes one stereo pair; arguments and errors as of `StereoTracker.step`.

        Raises:
            InputError: also when too little of the region in the first frame is seen by both eyes.
        """
        estimate = self._tracker.step(left, right, timestamp, mask)
        if not self._body.started:
            raise InputError(
                "the first frame has too few points that both eyes see: start where the images are good, "
                "and check the calibration"
            )
        if not estimate.has_pose:
            return ObjectEstimate(estimate)
        unseen, relative_poses = np.zeros((6, 6)), estimate.relative_poses
        if not self._body.separated:
            # In the body's frame, whose axes are the camera's still; from there into the left camera's.
            T_left_body = self._T_left_rectified @ self._body.T_camera_body
            if estimate.status != "starting":
                unseen = turn_covariance(T_left_body, self._body.unseen_motion())
                relative_poses = RelativePoses.empty()  # the body may have moved unseen
            self._unseen_motion.append(unseen)
        T_body_camera = self._T_body_left() @ estimate.T_world_camera
        return ObjectEstimate(
            replace(
                estimate,
                T_world_camera=T_body_camera,
                covariance=estimate.covariance + unseen,
                matching_covariance=estimate.matching_covariance + unseen,
                relative_poses=relative_poses,
            )
        )

    def final_trajectory(self) -> tuple[Trajectory, np.ndarray]:
        """T_camera_object of all frames with a pose as known now, covariances (N, 6, 6) in the body's own frame."""
        camera, covariances = self._tracker.final_trajectory()
        for covariance, unseen in zip(covariances, self._unseen_motion, strict=False):
            covariance += unseen
        T_body_camera = self._T_body_left() @ camera.poses
        turned = turn_covariance(T_body_camera, covariances)
        poses = se3_inverse(T_body_camera)
        return Trajectory(camera.timestamps, poses), 0.5 * (turned + turned.transpose(0, 2, 1))

    @property
    def last_frame(self) -> MatchedFrame | None:
        """As of `StereoTracker`."""
        return self._tracker.last_frame

    def warm_up(self) -> None:
        """As of `StereoTracker`."""
        self._tracker.warm_up()

    def map(self) -> PointMap:
        """The body's points, in its frame."""
        points = self._tracker.map()
        body = self._body.points()
        if len(body):
            # What was taken for the body's while it rested, and never moved with it, mostly lies beside it.
            body = body @ self._T_left_rectified[:3, :3].T
            slack = _SLACK * np.ptp(body, axis=0).max()
            inside = (points.points >= body.min(axis=0) - slack) & (points.points <= body.max(axis=0) + slack)
            points = points.select(inside.all(axis=1))
        return points.transform(self._T_body_left())

    def pack_keyframes(self) -> dict[str, Any]:
        """No arrays: a later run cannot find its place by a body."""
        return {}

    def _T_body_left(self) -> np.ndarray:  # noqa: N802
        return rigid_motion(np.eye(3), -self.origin)

"""The pose relative to what stands still, where a large part of the matches may be on something that moves."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.image_cells import explained_area, image_cells
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.two_view.stereo_pose import MIN_POINTS, RelativePose, estimate_relative_pose


@dataclass(frozen=True, slots=True)
class _Motion:
    """A pose that explains a part of the matches, its inliers.

    These stand for the share `area` of the image, of each cell for the share of its own matches; `disparity` is their
    median, pixels.
    """

    pose: RelativePose
    area: float
    disparity: float

    @classmethod
    def of(cls, pose: RelativePose, cells: np.ndarray, disparity: np.ndarray, probability: np.ndarray) -> Self:
        """Of matches (M,) in these cells, each with the disparity of its point and the probability that it is right."""
        return cls(pose, explained_area(cells, pose.inliers, probability), float(np.median(disparity[pose.inliers])))


def estimate_scene_pose(
    camera: RectifiedStereo,
    landmarks: np.ndarray,
    landmark_sigma: np.ndarray,
    measurement: np.ndarray,
    noise: np.ndarray,
    probability: np.ndarray,
    excludes: Callable[[np.ndarray], bool] | None = None,
) -> RelativePose | None:
    """Pose of the current view in the keyframe, relative to what stands still; arguments as `estimate_relative_pose`.

    `excludes` tells whether a sensor of motion rules a pose T_key_camera (4, 4) out: what moves is that one's.

    Matches that disagree with the first pose are asked for a second one. A bus ahead has more texture than the road
    around it, so of two motions not the one with more matches is the scene's but the one that explains more of the
    image, cell by cell. Where both explain much, what is farther away is the scene: what moves stands before it. And
    where that does not tell either, nobody knows.

    Returns:
        The pose; None where there is none, or two between which nothing decides.
    """
    matched = (landmarks, landmark_sigma, measurement, noise, probability)
    pose = estimate_relative_pose(camera, *matched)
    if pose is None:
        return None
    rest = np.flatnonzero(~pose.inliers)
    cells = image_cells(landmarks[:, :2], camera.width, camera.height)
    first = _Motion.of(pose, cells, landmarks[:, 2], probability)
    is_possible = excludes is None or not excludes(pose.T_key_camera)
    # All that disagree together may be too little for a rival.
    could_rival = is_rival(explained_area(cells, ~pose.inliers, probability), first.area)
    if len(rest) < MIN_POINTS or (is_possible and not could_rival):
        return pose
    other = estimate_relative_pose(camera, *(each[rest] for each in matched))
    if other is None:
        return pose
    agreeing = np.zeros(len(landmarks), bool)
    agreeing[rest[other.inliers]] = True
    other = replace(other, inliers=agreeing)
    second = _Motion.of(other, cells, landmarks[:, 2], probability)
    if excludes is not None and is_possible == excludes(other.T_key_camera):
        return pose if is_possible else other
    lesser, greater = sorted((first, second), key=lambda motion: motion.area)
    if not is_rival(lesser.area, greater.area) or _are_alike(camera, landmarks, pose, other):
        return greater.pose
    nearer, farther = sorted((first, second), key=lambda motion: -motion.disparity)
    return farther.pose if stands_before(nearer.disparity, farther.disparity) else None


def is_rival(area: float, greater: float) -> bool:
    """Whether what explains a share of the image may be the scene beside what explains a greater one."""
    return area >= ACCEPTANCE.rival_area * greater


def stands_before(disparity: float, other: float) -> bool:
    """Whether what has this median disparity stands clearly before what has the other one."""
    return disparity > ACCEPTANCE.scene_farther * other


def see_the_same(apart: np.ndarray) -> bool:
    """Whether two poses see most points (K,) at the same places, so many pixels apart."""
    return bool(are_one_place(np.median(apart)))


def are_one_place(apart: np.ndarray | np.floating) -> np.ndarray | np.bool_:
    """Whether places so many pixels apart are taken for the same."""
    return apart < ACCEPTANCE.same_motion


def _are_alike(camera: RectifiedStereo, landmarks: np.ndarray, one: RelativePose, other: RelativePose) -> bool:
    """Whether both poses see most points at the same places."""
    points = camera.triangulate(landmarks[landmarks[:, 2] > 0.0])
    first, second = (transform_points(se3_inverse(each.T_key_camera), points) for each in (one, other))
    front = (first[:, 2] > 0.0) & (second[:, 2] > 0.0)
    if not front.any():
        return False
    apart = camera.project(first[front])[:, :2] - camera.project(second[front])[:, :2]
    return see_the_same(np.linalg.norm(apart, axis=1))

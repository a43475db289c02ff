"""What the tracker does with stereo pairs, with any features: refined row matches, and the pose of the next view."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam_benchmarks.matching.extractors import Extractor, remembering
from sigmaslam_benchmarks.matching.scores import (
    KeypointsAndDescriptors,
    match_judged,
    match_rows_refined,
    mutual_nearest,
)

# A pose within these of the truth is good, metres and degrees.
GOOD_POSITION, GOOD_ROTATION_DEG = 0.05, 1.0
# Points below this disparity, in pixels, are too far for a pose.
_MIN_DISPARITY = 1.0
_MIN_POINTS = 6
_INLIER_THRESHOLD, _ITERATIONS, _CONFIDENCE = 2.0, 2000, 0.9999  # of RANSAC


@dataclass(frozen=True, slots=True)
class StereoStep:
    """From one rectified stereo pair to the next left image.

    Attributes:
        name: for messages.
        left0, right0, left1: (H, W) uint8; the same array where steps share an image.
        camera: of these images.
        T_1_0: (4, 4), takes points of the left camera 0 to the left camera 1, metres.
    """

    name: str
    left0: np.ndarray
    right0: np.ndarray
    left1: np.ndarray
    camera: RectifiedStereo
    T_1_0: np.ndarray


def score_steps(extractor: Extractor, steps: Sequence[StereoStep], judged: bool = False) -> dict[str, float]:
    """How often the pose of the next keyframe is found by PnP.

    Args:
        extractor: image to keypoints and descriptors.
        steps: from a pair to the next left image.
        judged: the matches are those of `sigmaslam match`, else mutual nearest neighbours.
    Returns:
        steps_good: number of steps with a pose within 5 cm and 1 degree of the truth; steps: of all; pnp_inliers: mean
        number of points that agree with the pose, 0 where there is none.
    """
    features = remembering(extractor)
    good, inliers = 0, 0
    for step in steps:
        left0, right0, left1 = (features(image) for image in (step.left0, step.right0, step.left1))
        found = estimate_step(step, left0, right0, left1, judged)
        if found is not None:
            good += is_good(found[0], step.T_1_0)
            inliers += found[1]
    return {"steps_good": float(good), "steps": float(len(steps)), "pnp_inliers": inliers / max(len(steps), 1)}


def is_good(T_1_0: np.ndarray, truth: np.ndarray) -> bool:
    """Whether a pose (4, 4) is within 5 cm and 1 degree of the true one."""
    # Positions of camera 1 in camera 0: the translation of T_1_0 itself would turn with the rotation's error.
    position, position_true = (-T[:3, :3].T @ T[:3, 3] for T in (T_1_0, truth))
    rotation = np.linalg.norm(rotation_log(T_1_0[:3, :3] @ truth[:3, :3].T))
    return bool(np.linalg.norm(position - position_true) < GOOD_POSITION and np.degrees(rotation) < GOOD_ROTATION_DEG)


def estimate_step(
    step: StereoStep,
    left0: KeypointsAndDescriptors,
    right0: KeypointsAndDescriptors,
    left1: KeypointsAndDescriptors,
    judged: bool = False,
) -> tuple[np.ndarray, int] | None:
    """Pose by stereo triangulation, mutual nearest neighbours in the next left image, P3P and refinement.

    Args:
        step: the images.
        left0, right0, left1: keypoints and descriptors of its three images.
        judged: as in `score_steps`.
    Returns:
        T_1_0 (4, 4) and the number of inliers, or None.
    """
    index, places = match_rows_refined(step.left0, step.right0, left0, right0)
    keypoints = left0[0][index].astype(np.float64)
    disparity = keypoints[:, 0] - places[:, 0]
    near = (disparity >= _MIN_DISPARITY) & (np.abs(keypoints[:, 1] - places[:, 1]) < 1.0)
    points = step.camera.triangulate(np.column_stack([keypoints, disparity])[near])
    kept = index[near]
    if not judged:
        first, second = mutual_nearest(left0[1][kept], left1[1])
        return _solve_pnp(points[first], left1[0][second].astype(np.float64), step.camera.matrix)
    matches = match_judged(step.left0, step.left1, (left0[0][kept], left0[1][kept]), left1)
    return _solve_pnp(points[matches.index0], matches.keypoints1.astype(np.float64), step.camera.matrix)


def _solve_pnp(points: np.ndarray, pixels: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Pose that takes (N, 3) points to where (N, 2) pixels see them, and the number of points that agree."""
    if len(points) < _MIN_POINTS:
        return None
    cv2.setRNGSeed(0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        K,
        None,
        flags=cv2.SOLVEPNP_AP3P,
        iterationsCount=_ITERATIONS,
        reprojectionError=_INLIER_THRESHOLD,
        confidence=_CONFIDENCE,
    )
    if not found or len(inliers) < _MIN_POINTS:
        return None
    index = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(points[index], pixels[index], K, None, rotation, translation)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return T, len(index)

"""Scores of one image pair and of many: matching accuracy, repeatability, homography and pose."""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np

from sigmaslam.frontend.image_pair import Matches, match_twice
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Features
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam_benchmarks.matching.eyes_by_descriptors import match_eyes
from sigmaslam_benchmarks.matching.image_pairs import Disparity, Homography, ImagePair, Motion, SameRows

CORNER_THRESHOLDS = (1, 3, 5)
POSE_THRESHOLDS = (1, 5, 10)
# Repeatability ignores keypoints within this many pixels of the border of the other image.
_BORDER = 8
# The robust estimators of everyone. OpenCV's USAC has its own generator: the same matches give the same answer. Its
# MAGSAC leaves some homographies of our photographs pixels off where least squares on the same inliers is right to a
# few tenths: beside it, graph-cut RANSAC with local optimisation.
_INLIER_THRESHOLD = 1.0
_POLISHED_THRESHOLD = 1.5
_CONFIDENCE = 0.9999
_ITERATIONS = 10_000
_CORNER_ERROR, _POLISHED_ERROR, _POSE_ERROR = "corner_error", "polished_corner_error", "pose_error_deg"

KeypointsAndDescriptors = tuple[np.ndarray, np.ndarray]


def mutual_nearest(descriptors0: np.ndarray, descriptors1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mutual nearest neighbours.

    Args:
        descriptors0, descriptors1: (N, C), (M, C) float of unit length, or uint8 bit strings.
    Returns:
        Indices (K,) into both, one to one.
    """
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        none = np.zeros(0, np.int64)
        return none, none
    similarity = _unit(descriptors0) @ _unit(descriptors1).T
    best1 = similarity.argmax(axis=1)
    index0 = np.flatnonzero(similarity.argmax(axis=0)[best1] == np.arange(len(best1)))
    return index0, best1[index0]


def match_rows_refined(
    left: np.ndarray, right: np.ndarray, features_left: KeypointsAndDescriptors, features_right: KeypointsAndDescriptors
) -> tuple[np.ndarray, np.ndarray]:
    """Stereo matches of a rectified pair from features of both eyes (`match_eyes`).

    Args:
        left, right: (H, W) uint8.
        features_left, features_right: their keypoints and descriptors.
    Returns:
        Indices (K,) into the left keypoints and their places (K, 2) in the right image; what is more likely wrong
        than right is left out.
    """
    found = match_eyes(_judge(), left, right, without_sigma(features_left), without_sigma(features_right))
    return found.index0, found.places


def score_pair(
    pair: ImagePair, features0: KeypointsAndDescriptors, features1: KeypointsAndDescriptors
) -> dict[str, float]:
    """What the features of both images achieve on this pair.

    Args:
        pair: images and truth.
        features0, features1: keypoints and descriptors, as an `Extractor` gives them.
    Returns:
        By kind of truth:
        homography and disparity: mma_1, mma_3 (share of the mutual matches within 1 and 3 px of the truth; matches of
        points without known disparity are left out), correct_3 (their number within 3 px), repeatability_1 (share of
        the keypoints of image 0 inside image 1 that are seen again within 1 px); homography: corner_error (mean over
        the corners of image 0, px, infinite without an estimate) by MAGSAC, polished_corner_error by graph-cut RANSAC.
        same rows: rows_1 (share of the matches with a row error below 1 px), row_matches (their number);
        rows_refined_1, rows_refined_matches: the same after matching within 2 rows and refinement.
        motion: epipolar_1 (share of the matches within 1 px of their epipolar line), epipolar_matches (their number),
        pose_error_deg (larger of the errors of rotation and of direction of translation, infinite without an estimate).
    """
    (keypoints0, descriptors0), (keypoints1, descriptors1) = features0, features1
    index0, index1 = mutual_nearest(descriptors0, descriptors1)
    points0, points1 = keypoints0[index0].astype(np.float64), keypoints1[index1].astype(np.float64)
    truth = pair.truth
    if isinstance(truth, SameRows):
        index, places = match_rows_refined(pair.image0, pair.image1, features0, features1)
        refined = np.abs(keypoints0[index, 1] - places[:, 1]) < 1.0
        return {
            **score_points(pair, points0, points1),
            "rows_refined_1": _share(refined),
            "rows_refined_matches": float(refined.sum()),
        }
    scores = score_points(pair, points0, points1)
    if not isinstance(truth, Motion):
        scores["repeatability_1"] = repeatability(keypoints0, keypoints1, truth, pair.image1.shape)
    return scores


def score_points(pair: ImagePair, points0: np.ndarray, points1: np.ndarray) -> dict[str, float]:
    """What matched points (N, 2), (N, 2) achieve on this pair, however they were matched.

    Returns:
        As `score_pair`, without repeatability and the scores of rows.
    """
    truth = pair.truth
    if isinstance(truth, SameRows):
        level = np.abs(points0[:, 1] - points1[:, 1]) < 1.0
        return {"rows_1": _share(level), "row_matches": float(level.sum())}
    if isinstance(truth, Motion):
        near = truth.epipolar_distance(points0, points1) < 1.0
        return {
            "epipolar_1": _share(near),
            "epipolar_matches": float(near.sum()),
            _POSE_ERROR: pose_error_deg(points0, points1, truth),
        }
    errors = np.linalg.norm(truth.transfer(points0) - points1, axis=1)
    errors = errors[~np.isnan(errors)]
    scores = {"mma_1": _share(errors < 1.0), "mma_3": _share(errors < 3.0), "correct_3": float((errors < 3.0).sum())}
    if isinstance(truth, Homography):
        shape = pair.image0.shape
        scores[_CORNER_ERROR] = corner_error(points0, points1, truth, shape, cv2.USAC_MAGSAC, _INLIER_THRESHOLD)
        scores[_POLISHED_ERROR] = corner_error(points0, points1, truth, shape, cv2.USAC_ACCURATE, _POLISHED_THRESHOLD)
    return scores


def repeatability(
    keypoints0: np.ndarray, keypoints1: np.ndarray, truth: Homography | Disparity, shape1: tuple[int, ...]
) -> float:
    """Share of keypoints (N, 2) of image 0, of those at least 8 px inside image 1, with one of (M, 2) within 1 px."""
    places = truth.transfer(keypoints0.astype(np.float64))
    height, width = shape1
    seen = ((places >= _BORDER) & (places < (width - _BORDER, height - _BORDER))).all(axis=1)
    if len(keypoints1) == 0:
        return 0.0
    places = places[seen]
    u = places[:, None, 0] - keypoints1[None, :, 0]
    v = places[:, None, 1] - keypoints1[None, :, 1]
    return _share((u * u + v * v).min(axis=1) < 1.0)


def corner_error(
    points0: np.ndarray,
    points1: np.ndarray,
    truth: Homography,
    shape0: tuple[int, ...],
    method: int = cv2.USAC_MAGSAC,
    threshold: float = _INLIER_THRESHOLD,
) -> float:
    """Mean distance of the corners of image 0 under the estimated and the true homography, pixels.

    Args:
        points0, points1: (N, 2) matched pixels.
        truth: the homography.
        shape0: (H, W) of image 0.
        method, threshold: of cv2.findHomography.
    """
    if len(points0) < 4:
        return np.inf
    H, _ = cv2.findHomography(points0, points1, method, threshold, maxIters=_ITERATIONS, confidence=_CONFIDENCE)
    # OpenCV gives None where it finds nothing, against its own type hints.
    if np.shape(H) != (3, 3):
        return np.inf
    bottom, right = shape0[0] - 1.0, shape0[1] - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    difference = Homography(H).transfer(corners) - truth.transfer(corners)
    return float(np.linalg.norm(difference, axis=1).mean())


def essential_by_magsac(
    points0: np.ndarray, points1: np.ndarray, K: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Essential matrix (3, 3) and inliers (N, 1) uint8 of matched pixels (N, 2) float64; None where there is none."""
    if len(points0) < 5:
        return None
    E, inliers = cv2.findEssentialMat(
        points0, points1, K, method=cv2.USAC_MAGSAC, prob=_CONFIDENCE, threshold=_INLIER_THRESHOLD, maxIters=_ITERATIONS
    )
    return (E, inliers) if np.shape(E) == (3, 3) else None


def pose_by_magsac(points0: np.ndarray, points1: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation (3, 3) and direction of translation (3,) from camera 0 to camera 1; None where there is none."""
    found = essential_by_magsac(points0, points1, K)
    if found is None:
        return None
    _, R, direction, _ = cv2.recoverPose(found[0], points0, points1, K, mask=found[1])
    return R, direction.ravel()


def pose_errors_deg(R: np.ndarray, direction: np.ndarray, T_1_0: np.ndarray) -> tuple[float, float]:
    """Angles between estimated and true rotation, and direction of translation, degrees."""
    translation = T_1_0[:3, 3]
    cosine = float(direction @ translation) / np.linalg.norm(translation)
    rotation = np.linalg.norm(rotation_log(R.T @ T_1_0[:3, :3]))
    return float(np.degrees(rotation)), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def pose_error_deg(points0: np.ndarray, points1: np.ndarray, truth: Motion) -> float:
    """Larger of the angles between estimated and true rotation, and direction of translation, degrees.

    Args:
        points0, points1: (N, 2) matched pixels.
        truth: intrinsics and motion; the translation must not be zero.
    """
    pose = pose_by_magsac(points0, points1, truth.K)
    return np.inf if pose is None else max(pose_errors_deg(*pose, truth.T_1_0))


def area_under_curve(errors: Sequence[float], threshold: float) -> float:
    """Area under the share of errors below x, for x from 0 to `threshold`, over the area of all right.

    The exact integral of the empirical distribution; the trapezoids of others give more where there are few pairs.
    """
    return float(np.clip(1.0 - np.asarray(errors) / threshold, 0.0, 1.0).mean())


def summarize(pairs: Sequence[dict[str, float]]) -> dict[str, float]:
    """Means of what `score_pair` gave; errors become auc_1, _3, _5, polished_auc_1, ... (px) and pose_auc_1, _5, _10
    (degrees)."""
    summary: dict[str, float] = {}
    for name in pairs[0]:
        values = [pair[name] for pair in pairs]
        if name == _CORNER_ERROR:
            summary |= {f"auc_{limit}": area_under_curve(values, limit) for limit in CORNER_THRESHOLDS}
        elif name == _POLISHED_ERROR:
            summary |= {f"polished_auc_{limit}": area_under_curve(values, limit) for limit in CORNER_THRESHOLDS}
        elif name == _POSE_ERROR:
            summary |= {f"pose_auc_{limit}": area_under_curve(values, limit) for limit in POSE_THRESHOLDS}
        else:
            summary[name] = float(np.mean(values))
    return summary


def without_sigma(features: KeypointsAndDescriptors) -> Features:
    """What the judge takes; everyone's scores and sigmas are taken to be the same, as not all extractors give them."""
    keypoints, descriptors = features
    alike = np.ones(len(keypoints), np.float32)
    return Features(keypoints, _unit(descriptors), alike, alike)


@cache
def _judge() -> ConfidenceEstimator:
    return ConfidenceEstimator()


def match_judged(
    image0: np.ndarray, image1: np.ndarray, features0: KeypointsAndDescriptors, features1: KeypointsAndDescriptors
) -> Matches:
    """What `sigmaslam match` makes of anyone's keypoints and descriptors if all have the same score and sigma."""
    return match_twice(_judge(), image0, image1, without_sigma(features0), without_sigma(features1))


def _unit(descriptors: np.ndarray) -> np.ndarray:
    """Bit strings as +-1, whose dot product falls with their Hamming distance, of unit length; others as they are."""
    if descriptors.dtype != np.uint8:
        return descriptors
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    return np.asarray((2.0 * bits - 1.0) / np.sqrt(max(bits.shape[1], 1)), np.float32)


def _share(right: np.ndarray) -> float:
    return float(right.mean()) if len(right) else 0.0

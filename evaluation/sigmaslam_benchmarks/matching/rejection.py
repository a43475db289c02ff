"""Telling right matches from wrong ones: our scorer beside the ratio test, AdaLAM and MAGSAC, on the same matches."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from kornia.feature.adalam.adalam import AdalamFilter

from sigmaslam.frontend.classical import SiftDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import Putative, nearest_anywhere
from sigmaslam.frontend.types import Features
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion
from sigmaslam_benchmarks.matching.scores import essential_by_magsac

KEYPOINTS = 2000
_RIGHT = 1.5
"""Distance from the epipolar line of a right match, pixels."""
_THINNED = 0.25
_RATIOS = (0.8, 0.9)


@dataclass(frozen=True, slots=True)
class _Task:
    """SIFT's nearest neighbours of one pair, and what the contenders need beside them.

    Attributes:
        frames0, frames1: (N, 2) size and angle (degrees) of the keypoints.
        right: (M,) bool.
    """

    pair: ImagePair
    features0: Features
    features1: Features
    frames0: np.ndarray
    frames1: np.ndarray
    putative: Putative
    right: np.ndarray


@dataclass(frozen=True, slots=True)
class Rejection:
    """Means over the pairs of a set.

    Attributes:
        f1, precision, recall: of the accepted matches.
        milliseconds: median.
    """

    f1: float
    precision: float
    recall: float
    milliseconds: float


def compare_rejection(
    pairs: Sequence[ImagePair], judge: ConfidenceEstimator, thinned: bool
) -> tuple[float, dict[str, Rejection]]:
    """Everyone on the pairs with a known motion.

    Args:
        pairs: with motion.
        judge: ours.
        thinned: right matches are taken out at random until a quarter is right.
    Returns:
        Mean share of right matches, and what each contender reached.
    """
    contenders: dict[str, Callable[[_Task], np.ndarray]] = {
        "ours": lambda task: judge.score(task.putative, task.features0, task.features1) > 0,
        **{f"mutual + ratio {ratio}": _ratio_test(ratio) for ratio in _RATIOS},
        "AdaLAM (kornia)": _adalam,
        "MAGSAC": _magsac,
    }
    outcomes: dict[str, list[tuple[float, ...]]] = {name: [] for name in contenders}
    shares = []
    for number, pair in enumerate(pairs):
        task = _make_task(pair)
        if thinned:
            task = _thin(task, np.random.default_rng(number))
        shares.append(task.right.mean())
        for name, contender in contenders.items():
            begin = time.perf_counter()
            accepted = contender(task)
            elapsed = 1e3 * (time.perf_counter() - begin)
            both = float((accepted & task.right).sum())
            precision, recall = both / max(accepted.sum(), 1), both / max(task.right.sum(), 1)
            outcomes[name].append((2 * both / max(accepted.sum() + task.right.sum(), 1), precision, recall, elapsed))
    results = {}
    for name, values in outcomes.items():
        f1, precision, recall, milliseconds = np.array(values).T
        results[name] = Rejection(
            float(f1.mean()), float(precision.mean()), float(recall.mean()), float(np.median(milliseconds))
        )
    return float(np.mean(shares)), results


def _make_task(pair: ImagePair) -> _Task:
    if not isinstance(pair.truth, Motion):
        raise ValueError(f"pair {pair.name}: its motion is not known")
    (features0, frames0), (features1, frames1) = _detect(pair.image0), _detect(pair.image1)
    putative = nearest_anywhere(features0.descriptors, features1.descriptors)
    points0, points1 = features0.keypoints[putative.index0], features1.keypoints[putative.index1]
    right = pair.truth.epipolar_distance(points0.astype(np.float64), points1.astype(np.float64)) < _RIGHT
    return _Task(pair, features0, features1, frames0, frames1, putative, right)


def _detect(image: np.ndarray) -> tuple[Features, np.ndarray]:
    features = SiftDetector(KEYPOINTS)(image)
    frame_of: dict[tuple[float, float], tuple[float, float]] = {}
    for keypoint in cv2.SIFT.create(nfeatures=KEYPOINTS).detect(image, None):
        u, v = keypoint.pt
        frame_of.setdefault((u, v), (keypoint.size, keypoint.angle))
    return features, np.array([frame_of[float(u), float(v)] for u, v in features.keypoints])


def _thin(task: _Task, rng: np.random.Generator) -> _Task:
    wrong, right = np.flatnonzero(~task.right), np.flatnonzero(task.right)
    kept = min(len(right), round(len(wrong) * _THINNED / (1.0 - _THINNED)))
    rows = np.sort(np.concatenate([wrong, rng.permutation(right)[:kept]]))
    # Row k of the matches belongs to keypoint k of image 0: drop both together.
    features0 = task.features0.select(rows)
    putative = nearest_anywhere(features0.descriptors, task.features1.descriptors)
    return _Task(task.pair, features0, task.features1, task.frames0[rows], task.frames1, putative, task.right[rows])


def _ratio_test(ratio: float) -> Callable[[_Task], np.ndarray]:
    return lambda task: task.putative.mutual & task.putative.distinct(ratio)


def _magsac(task: _Task) -> np.ndarray:
    assert isinstance(task.pair.truth, Motion)
    points0, points1 = (
        features.keypoints[index].astype(np.float64)
        for features, index in ((task.features0, task.putative.index0), (task.features1, task.putative.index1))
    )
    essential = essential_by_magsac(points0, points1, task.pair.truth.K)
    return np.zeros(len(points0), bool) if essential is None else essential[1].ravel() > 0


def _adalam(task: _Task) -> np.ndarray:
    putative = task.putative
    distance = np.maximum(2.0 - 2.0 * putative.similarity, 0.0)
    ratio = distance / np.maximum(2.0 - 2.0 * putative.second0, 1e-3)
    filtered = AdalamFilter().filter_matches(
        torch.from_numpy(task.features0.keypoints),
        torch.from_numpy(task.features1.keypoints),
        torch.from_numpy(putative.index1),
        torch.from_numpy(ratio.astype(np.float32)),
        torch.from_numpy(putative.mutual),
        task.pair.image0.shape,
        task.pair.image1.shape,
        o1=torch.from_numpy(task.frames0[:, 1]).float(),
        o2=torch.from_numpy(task.frames1[:, 1]).float(),
        s1=torch.from_numpy(task.frames0[:, 0]).float(),
        s2=torch.from_numpy(task.frames1[:, 0]).float(),
    )
    accepted = np.zeros(len(putative.index0), bool)
    accepted[np.asarray(filtered)[:, 0]] = True
    return accepted

"""Relative pose of two views without a prediction: ours from judged matches beside MAGSAC."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam.frontend.image_pair import Matches, match_features
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import nearest_anywhere
from sigmaslam.frontend.types import Features
from sigmaslam.two_view.epipolar import estimate_epipolar_pose
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion
from sigmaslam_benchmarks.matching.scores import pose_by_magsac, pose_errors_deg

# Below this length, in metres, the direction of a translation is undefined.
_MIN_TRANSLATION = 0.02
# Our estimator also takes improbable matches: its weights suppress them.
_MIN_PROBABILITY = 0.05
_ROUNDS = 5

_Pose = tuple[np.ndarray, np.ndarray] | None


@dataclass(frozen=True, slots=True)
class StartScore:
    """Of one estimator on one set; errors in degrees, 180 where there is no pose.

    Attributes:
        rotation, direction: median errors of rotation and of the direction of translation.
        mean: mean of the larger of the two.
        milliseconds: median over the pairs of the least of five rounds, without matching.
    """

    rotation: float
    direction: float
    mean: float
    milliseconds: float


def compare_starts(
    pairs: Sequence[ImagePair], detect: Callable[[np.ndarray], Features], judge: ConfidenceEstimator
) -> dict[str, StartScore]:
    """Everyone on the pairs with a known motion that is more than a turn.

    Args:
        pairs: others are left out.
    """
    measured: dict[str, list[tuple[float, float, float]]] = {}
    for pair in pairs:
        truth = pair.truth
        if not isinstance(truth, Motion) or np.linalg.norm(truth.T_1_0[:3, 3]) < _MIN_TRANSLATION:
            continue
        features0, features1 = detect(pair.image0), detect(pair.image1)
        putative = nearest_anywhere(features0.descriptors, features1.descriptors)
        mutual = putative.select(putative.mutual)
        points0 = features0.keypoints[mutual.index0].astype(np.float64)
        points1 = features1.keypoints[mutual.index1].astype(np.float64)
        matches = match_features(judge, pair.image0, pair.image1, features0, features1, _MIN_PROBABILITY)
        contenders = _contenders(points0, points1, matches, truth.K)
        # Interleave the contenders, so that a busy moment of the machine hits all of them.
        times = np.full((_ROUNDS, len(contenders)), np.inf)
        for turn in range(_ROUNDS):
            for column, (name, estimate) in enumerate(contenders.items()):
                begin = time.perf_counter()
                pose = estimate()
                times[turn, column] = 1e3 * (time.perf_counter() - begin)
                if turn == 0:
                    errors = (180.0, 180.0) if pose is None else pose_errors_deg(*pose, truth.T_1_0)
                    measured.setdefault(name, []).append((*errors, 0.0))
        for column, name in enumerate(contenders):
            measured[name][-1] = (*measured[name][-1][:2], float(times[:, column].min()))
    return {name: _summary(np.array(values)) for name, values in measured.items()}


def _contenders(
    points0: np.ndarray, points1: np.ndarray, matches: Matches, K: np.ndarray
) -> dict[str, Callable[[], _Pose]]:
    probable = matches.probability >= 0.5
    probable_points = [each[probable].astype(np.float64) for each in (matches.keypoints0, matches.keypoints1)]

    def ours() -> _Pose:
        pose = estimate_epipolar_pose(
            K, matches.keypoints0, matches.keypoints1, matches.probability, matches.covariance
        )
        return None if pose is None else (pose.R, pose.direction)

    return {
        "MAGSAC, mutual nearest neighbours": lambda: pose_by_magsac(points0, points1, K),
        "MAGSAC, our refined matches": lambda: pose_by_magsac(probable_points[0], probable_points[1], K),
        "ours": ours,
    }


def _summary(values: np.ndarray) -> StartScore:
    rotation, direction, milliseconds = np.median(values, axis=0)
    return StartScore(float(rotation), float(direction), float(values[:, :2].max(axis=1).mean()), float(milliseconds))

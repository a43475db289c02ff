"""Whether the probability of matches holds when the camera advances and where structure repeats itself."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam.frontend.image_pair import match_features
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Features
from sigmaslam_benchmarks.matching.eyes_by_descriptors import match_eyes
from sigmaslam_benchmarks.matching.stereo import StereoStep
from sigmaslam_evaluation.metrics import probability_calibration as calibration
from sigmaslam_evaluation.metrics.probability_calibration import RIGHT
from sigmaslam_synthetic.homography_pairs import HomographyPair
from sigmaslam_synthetic.scene_pairs import ScenePair

EDGES = (0.0, 0.2, 0.5, 0.8, 0.95, 1.0)
"""Of the probabilities whose shares of right matches are told."""
_LIKELY = 0.5
# Stereo matches that give a depth: their probability, and disparity in pixels.
_SURE, _LEAST_DISPARITY = 0.9, 0.5

Detect = Callable[[np.ndarray], Features]


@dataclass(frozen=True, slots=True)
class MeasuredMatches:
    """Mutual nearest neighbours of some pairs that the scorer does not refuse.

    Attributes:
        probability: (M,).
        error: (M,) distance from the true place, pixels.
        deviation: (M, 2) errors along the axes of the covariance over their standard deviations; None where the truth
            is too coarse for that.
    """

    probability: np.ndarray
    error: np.ndarray
    deviation: np.ndarray | None


@dataclass(frozen=True, slots=True)
class ProbabilityJudgement:
    """Of the matches of one set.

    Attributes:
        matches: how many.
        claimed, right: mean probability and share of right ones, by bins of `EDGES`; NaN where there is none.
        ece: expected calibration error.
        precision: share of right ones among the likely, which `sigmaslam match` gives by default.
        lost: share of the right ones that are not among these.
        within_1, within_2: share of the errors of right ones within one and two sigma along either axis; NaN where
            the truth does not say.
    """

    matches: int
    claimed: tuple[float, ...]
    right: tuple[float, ...]
    ece: float
    precision: float
    lost: float
    within_1: float
    within_2: float


def judge_probability(measured: MeasuredMatches) -> ProbabilityJudgement:
    """What the probabilities and sigmas claim beside what is true."""
    probability, right = measured.probability, measured.error < RIGHT
    likely = probability >= _LIKELY
    bins = np.clip(np.digitize(probability, EDGES) - 1, 0, len(EDGES) - 2)
    claimed, found = (
        tuple(float(values[bins == k].mean()) if (bins == k).any() else np.nan for k in range(len(EDGES) - 1))
        for values in (probability, right)
    )
    within = (
        (np.nan, np.nan)
        if measured.deviation is None
        else tuple(float((np.abs(measured.deviation[right]) < sigmas).mean()) for sigmas in (1.0, 2.0))
    )
    return ProbabilityJudgement(
        len(probability),
        claimed,
        found,
        calibration.calibration_error(probability, right),
        float(right[likely].mean()) if likely.any() else np.nan,
        float((right & ~likely).sum() / max(right.sum(), 1)),
        *within,
    )


def measure_steps(steps: Sequence[StereoStep], detect: Detect, judge: ConfidenceEstimator) -> MeasuredMatches:
    """Matches of pairs whose motion is known, of the keypoints that stereo gives a depth.

    The distance from the epipolar line would not do: where a camera advances most wrong matches lie near it too.
    """
    return _join(_of_step(step, detect, judge) for step in steps)


def measure_renders(
    pairs: Iterable[ScenePair | HomographyPair], detect: Detect, judge: ConfidenceEstimator
) -> MeasuredMatches:
    """Matches of rendered pairs, whose truth is exact."""
    return _join(_of_render(pair, detect, judge) for pair in pairs)


def _of_step(step: StereoStep, detect: Detect, judge: ConfidenceEstimator) -> MeasuredMatches:
    left, right, later = detect(step.left0), detect(step.right0), detect(step.left1)
    eyes = match_eyes(judge, step.left0, step.right0, left, right)
    eyes = eyes.select(eyes.probability >= _SURE)
    disparity = np.full(len(left.keypoints), np.nan)
    disparity[eyes.index0] = left.keypoints[eyes.index0, 0] - eyes.places[:, 0]
    matches = match_features(judge, step.left0, step.left1, left, later, 0.0)
    matches = matches.select(np.nan_to_num(disparity[matches.index0]) > _LEAST_DISPARITY)
    points = step.camera.triangulate(np.column_stack([matches.keypoints0, disparity[matches.index0]]))
    seen = points @ step.T_1_0[:3, :3].T + step.T_1_0[:3, 3]
    in_front = seen[:, 2] > 0
    places = np.full((len(seen), 2), np.inf)
    places[in_front] = step.camera.project(seen[in_front])[:, :2]
    error = np.linalg.norm(matches.keypoints1 - places, axis=1)
    return MeasuredMatches(matches.probability, error, None)


def _of_render(pair: ScenePair | HomographyPair, detect: Detect, judge: ConfidenceEstimator) -> MeasuredMatches:
    image0, image1 = (np.round(255.0 * image).astype(np.uint8) for image in (pair.image0, pair.image1))
    matches = match_features(judge, image0, image1, detect(image0), detect(image1), 0.0)
    places, visible = pair.transfer(matches.keypoints0.astype(np.float64))
    error = np.where(visible[:, None], matches.keypoints1 - places, np.inf)
    variance, axes = np.linalg.eigh(matches.covariance.astype(np.float64))
    along_axes = np.einsum("mji,mj->mi", axes, np.where(visible[:, None], error, 0.0))
    return MeasuredMatches(matches.probability, np.linalg.norm(error, axis=1), along_axes / np.sqrt(variance))


def _join(parts: Iterator[MeasuredMatches]) -> MeasuredMatches:
    every = list(parts)
    deviations = [part.deviation for part in every if part.deviation is not None]
    return MeasuredMatches(
        np.concatenate([part.probability for part in every]),
        np.concatenate([part.error for part in every]),
        np.concatenate(deviations) if deviations else None,
    )

"""Whether probability and covariance of matches hold on real images: homographies, and rows of rectified pairs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_95
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.frontend.affine_alignment import refine_by_neighbours
from sigmaslam.frontend.descriptor import match_rows
from sigmaslam.frontend.match_confidence import MIN_LOGIT, ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import nearest_anywhere
from sigmaslam.frontend.row_search import search_rows
from sigmaslam.frontend.types import Features
from sigmaslam.frontend.verifier_inputs import PlaceSearch
from sigmaslam_benchmarks.matching.image_pairs import Homography, ImagePair, SameRows
from sigmaslam_evaluation.metrics import probability_calibration as calibration
from sigmaslam_evaluation.metrics.probability_calibration import RIGHT

_CONSTANT_SIGMA = 0.3
# Scale, in pixels, and iterations of the robust fit of the rectification error.
_RECTIFICATION_SCALE, _RECTIFICATION_FITS = 0.3, 20

Detect = Callable[[np.ndarray], Features]


@dataclass(frozen=True, slots=True)
class HomographyJudgement:
    """Of one set; ranking scores are means over the pairs, the rest is of all matches of the set together.

    Attributes:
        ratio_precision, precision: average precision among all nearest neighbours by mutual and ratio, and by the
            scorer.
        ratio_auroc, scorer_auroc, auroc: AUROC among mutual nearest neighbours by the ratio of distances, by the
            scorer, and of the final probability.
        ece: expected calibration error of the final probability.
        spearman_before, spearman: rank correlation of the right matches' errors with the keypoints' own sigma, and
            with the sigma of the covariance.
        best_half: root mean square error of the half with the smaller sigma over that of all right matches.
        inside: share of right matches in their 95 % ellipse.
        median: error of the right matches, pixels.
    """

    ratio_precision: float
    precision: float
    ratio_auroc: float
    scorer_auroc: float
    auroc: float
    ece: float
    spearman_before: float
    spearman: float
    best_half: float
    inside: float
    median: float


def judge_homographies(pairs: Sequence[ImagePair], detect: Detect, judge: ConfidenceEstimator) -> HomographyJudgement:
    """Judges the matches of pairs whose homography is known.

    Args:
        pairs: with homographies.
    """
    ranked: list[tuple[float, ...]] = []
    pooled: list[tuple[np.ndarray, ...]] = []
    for pair in pairs:
        assert isinstance(pair.truth, Homography)
        features0, features1 = detect(pair.image0), detect(pair.image1)
        putative = nearest_anywhere(features0.descriptors, features1.descriptors)
        points0 = features0.keypoints[putative.index0].astype(np.float64)
        points1 = features1.keypoints[putative.index1].astype(np.float64)
        places = pair.truth.transfer(points0)
        near = np.linalg.norm(points1 - places, axis=1) < RIGHT
        logit = judge.score(putative, features0, features1)
        ratio = (1.0 - putative.similarity) / np.maximum(1.0 - putative.second0, 1e-6)
        mutual = putative.mutual
        precisions = [calibration.average_precision(score, near) for score in (10.0 * mutual - ratio, logit)]
        # Score the same matches before and after verification, also those that the verifier does not see.
        seen = np.flatnonzero(mutual & (logit > MIN_LOGIT))
        refinement = refine_by_neighbours(pair.image0, pair.image1, points0[seen], points1[seen], logit[seen])
        sigma = features0.sigma[putative.index0[seen]], features1.sigma[putative.index1[seen]]
        verified, covariance = judge.verify(pair.image0, pair.image1, points0[seen], logit[seen], refinement, sigma)
        probability, error = np.zeros(len(logit)), points1 - places
        probability[seen], error[seen] = verified, refinement.places - places[seen]
        right = np.linalg.norm(error, axis=1) < RIGHT
        ranked.append(
            (
                *precisions,
                calibration.auroc(-ratio[mutual], near[mutual]),
                calibration.auroc(logit[mutual], near[mutual]),
                calibration.auroc(probability[mutual], right[mutual]),
            )
        )
        good = right[seen]
        before = np.hypot(*sigma)
        pooled.append((error[seen][good], covariance[good], before[good], probability[mutual], right[mutual]))
    error, covariance, before, probability, right = (np.concatenate(values) for values in zip(*pooled, strict=True))
    length = np.linalg.norm(error, axis=1)
    size = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    ratio_precision, precision, ratio_auroc, scorer_auroc, final_auroc = np.nanmean(ranked, axis=0).tolist()
    return HomographyJudgement(
        ratio_precision,
        precision,
        ratio_auroc,
        scorer_auroc,
        final_auroc,
        calibration.calibration_error(probability, right),
        calibration.spearman(before, length),
        calibration.spearman(size, length),
        calibration.best_half(size, length),
        float((squared_mahalanobis(error, covariance.astype(np.float64)) < CHI_SQUARE_95[2]).mean()),
        float(np.median(length)),
    )


@dataclass(frozen=True, slots=True)
class RowJudgement:
    """Row errors of the stereo matches of one set over their sigma.

    Attributes:
        matches: a pair.
        within_1, within_2: share within 1 and 2 sigma, as the images are rectified.
        mended_1, mended_2: the same with what is left of the rectification taken out.
        constant_1, constant_2: the same with 0.3 px for all, the rectification mended.
        spearman: rank correlation of sigma and mended error.
        median, median_sigma: of the mended error and of sigma, pixels.
        bias: median row error before mending, pixels.
    """

    matches: float
    within_1: float
    within_2: float
    mended_1: float
    mended_2: float
    constant_1: float
    constant_2: float
    spearman: float
    median: float
    median_sigma: float
    bias: float


def judge_rows(pairs: Sequence[ImagePair], detect: Detect, judge: ConfidenceEstimator) -> RowJudgement:
    """Judges the stereo matches that the tracker uses by the difference of their rows, which should be zero.

    What is left of the rectification is common to all pairs of a set: a polynomial of second degree in the place, as a
    small rotation and another focal length give it, fitted robustly to all of them.

    Args:
        pairs: rectified.
    """
    rows = []
    for pair in pairs:
        assert isinstance(pair.truth, SameRows)
        features = detect(pair.image0)
        index, start = search_rows(pair.image0, pair.image1, features.keypoints)
        points = features.keypoints[index].astype(np.float64)
        found = match_rows(
            judge, pair.image0, pair.image1, points, start, features.sigma[index], PlaceSearch.ALONG_ROWS
        )
        points = points[found.index]
        height, width = pair.image0.shape
        place = (points - (0.5 * width, 0.5 * height)) / (0.5 * width)
        rows.append(np.column_stack([found.places[:, 1] - points[:, 1], np.sqrt(found.covariance[:, 1, 1]), place]))
    error, sigma, u, v = np.concatenate(rows).T
    mended = error - _rectification(error, u, v)
    return RowJudgement(
        len(error) / len(pairs),
        _share_within(error, sigma, 1.0),
        _share_within(error, sigma, 2.0),
        _share_within(mended, sigma, 1.0),
        _share_within(mended, sigma, 2.0),
        _share_within(mended, _CONSTANT_SIGMA, 1.0),
        _share_within(mended, _CONSTANT_SIGMA, 2.0),
        calibration.spearman(sigma, np.abs(mended)),
        float(np.median(np.abs(mended))),
        float(np.median(sigma)),
        float(np.median(error)),
    )


def _share_within(error: np.ndarray, sigma: np.ndarray | float, factor: float) -> float:
    return float((np.abs(error) < factor * sigma).mean())


def _rectification(error: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    design = np.column_stack([np.ones_like(u), u, v, u * v, v * v])
    weight = np.ones(len(error))
    fitted = np.zeros(len(error))
    for _ in range(_RECTIFICATION_FITS):
        root = np.sqrt(weight)
        fitted = design @ np.linalg.lstsq(design * root[:, None], error * root, rcond=None)[0]
        weight = 1.0 / (1.0 + ((error - fitted) / _RECTIFICATION_SCALE) ** 2)
    return fitted

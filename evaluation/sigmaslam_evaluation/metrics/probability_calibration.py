"""Whether probabilities and sigmas mean what they say."""

import numpy as np
from scipy.stats import rankdata

RIGHT = 3.0
"""A match this near to the truth is right, pixels."""
_BINS = 15


def auroc(score: np.ndarray, right: np.ndarray) -> float:
    """Area under the ROC curve: how often a right match (M,) bool has a larger score (M,) than a wrong one; ties half.

    NaN unless there are both.
    """
    rank = rankdata(score)
    count = int(right.sum())
    others = len(right) - count
    if count == 0 or others == 0:
        return float("nan")
    return float((rank[right].sum() - 0.5 * count * (count + 1)) / (count * others))


def average_precision(score: np.ndarray, right: np.ndarray) -> float:
    """Mean precision over the right matches, from the largest score down; NaN without a right one."""
    ordered = right[np.argsort(-score, kind="stable")]
    precision = np.cumsum(ordered) / np.arange(1, len(ordered) + 1)
    return float(precision[ordered].mean()) if ordered.any() else float("nan")


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation of two (M,); NaN where one of them is the same throughout."""
    ranks0, ranks1 = rankdata(a), rankdata(b)
    # scipy's spearmanr differs in the last bit.
    if len(a) < 2 or np.ptp(ranks0) == 0 or np.ptp(ranks1) == 0:
        return float("nan")
    return float(np.corrcoef(ranks0, ranks1)[0, 1])


def best_half(sigma: np.ndarray, error: np.ndarray) -> float:
    """Root mean square of the errors (M,) of the half with the smaller sigma (M,), over that of all."""
    best = error[np.argsort(sigma, kind="stable")[: len(error) // 2]]
    return float(np.sqrt(np.mean(best**2) / np.mean(error**2)))


def calibration_error(probability: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error (Guo et al. 2017): mean gap of probability and share of right ones, over 15 bins."""
    bins = np.minimum((probability * _BINS).astype(int), _BINS - 1)
    gap = np.bincount(bins, probability, _BINS) - np.bincount(bins, right.astype(np.float64), _BINS)
    return float(np.abs(gap).sum() / max(len(right), 1))

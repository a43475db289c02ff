"""Nearest neighbours among unit descriptors, restricted to where geometry allows them."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_99_OF_2
from sigmaslam.table import Table

# A missing neighbour has this similarity, the smallest that two unit vectors can have.
_NO_SIMILARITY = -1.0
# From this share of all pairs on, the product of all descriptors is faster than gathering those of the pairs.
_DENSE_FROM = 1 / 8


@dataclass(frozen=True, slots=True)
class Putative(Table):
    """Putative matches: keypoints of image 0 with their nearest neighbours in image 1, right or wrong.

    Attributes:
        index0, index1: (M,) keypoints of either image; each of image 0 at most once.
        similarity: (M,) of their descriptors.
        second0: (M,) similarity of the keypoint of image 0 to its runner-up; -1 where there is none.
        second1: (M,) similarity of the keypoint of image 1 to the best other one of image 0; -1 where there is none.
    """

    index0: np.ndarray
    index1: np.ndarray
    similarity: np.ndarray
    second0: np.ndarray
    second1: np.ndarray

    @property
    def mutual(self) -> np.ndarray:
        """(M,) bool: neither keypoint has a better partner. Mutual matches are one to one; exact ties do not match."""
        return np.asarray((self.similarity > self.second0) & (self.similarity > self.second1))

    def distinct(self, ratio: float) -> np.ndarray:
        """(M,) bool: the squared distance to the best is less than ratio^2 times that to the runner-up."""
        # The margin keeps two identical candidates, both at distance zero, from passing as distinct.
        return np.asarray((1.0 - self.similarity) + 1e-6 <= ratio * ratio * (1.0 - self.second0))


def nearest_anywhere(descriptors0: np.ndarray, descriptors1: np.ndarray) -> Putative:
    """Nearest neighbours among all keypoints of two images with descriptors (N, D), (M, D) of unit length."""
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        return _none()
    similarity = descriptors0 @ descriptors1.T
    rows, columns = np.arange(len(descriptors0)), np.arange(len(descriptors1))
    index1, index0 = similarity.argmax(axis=1), similarity.argmax(axis=0)
    best1, best0 = similarity[rows, index1], similarity[index0, columns]
    similarity[rows, index1] = _NO_SIMILARITY
    second = similarity.max(axis=1)
    similarity[rows, index1] = best1
    similarity[index0, columns] = _NO_SIMILARITY
    other = np.where(index0[index1] == rows, similarity.max(axis=0)[index1], best0[index1])
    return Putative(rows, index1, best1, second, other)


def nearest_in_ellipses(
    predicted: np.ndarray,
    covariance: np.ndarray,
    keypoints: np.ndarray,
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
) -> Putative:
    """Nearest neighbours within the 99 % ellipses about predicted places.

    Args:
        predicted: (N, 2) expected pixel coordinates in image 1.
        covariance: (N, 2, 2) of the prediction, pixels squared, positive definite.
        keypoints: (M, 2) of image 1.
        descriptors0, descriptors1: (N, D), (M, D) of unit length.
    """
    half_height = np.sqrt(CHI_SQUARE_99_OF_2 * covariance[:, 1, 1])
    first, second = pairs_in_band(predicted[:, 1], half_height, keypoints[:, 1])
    offset = keypoints[second] - predicted[first]
    # The bounding box of the ellipse goes first: most pairs of a band are far outside.
    close = np.abs(offset[:, 0]) <= np.sqrt(CHI_SQUARE_99_OF_2 * covariance[:, 0, 0])[first]
    first, second, offset = first[close], second[close], offset[close]
    inside = within_ellipses(offset, covariance[first])
    return nearest_among_pairs(descriptors0, descriptors1, first[inside], second[inside])


def nearest_among_pairs(
    descriptors0: np.ndarray, descriptors1: np.ndarray, first: np.ndarray, second: np.ndarray
) -> Putative:
    """Nearest neighbours where only some pairs of keypoints are allowed.

    Args:
        descriptors0, descriptors1: (N, D), (M, D) of unit length.
        first, second: (K,), (K,) keypoints of the allowed pairs, the first in ascending order.
    """
    if len(first) == 0:
        return _none()
    if len(first) > _DENSE_FROM * len(descriptors0) * len(descriptors1):
        similarity = (descriptors0 @ descriptors1.T)[first, second]
    else:
        similarity = np.einsum("kd,kd->k", descriptors0[first], descriptors1[second])
    _, place0, runner_up0 = _two_best(similarity, first, len(descriptors0))
    best1, place1, runner_up1 = _two_best(similarity, second, len(descriptors1))
    index0 = np.flatnonzero(place0 >= 0)
    place = place0[index0]
    index1 = second[place]
    other = np.where(place1[index1] == place, runner_up1[index1], best1[index1])
    return Putative(index0, index1, similarity[place], runner_up0[index0], other)


def within_ellipses(offset: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(K,) bool, whether offsets (K, 2) lie in the 99 % ellipses of covariances (K, 2, 2)."""
    u, v = offset.T
    uu, uv, vv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(vv * u * u - 2.0 * uv * u * v + uu * v * v <= CHI_SQUARE_99_OF_2 * (uu * vv - uv * uv))


def pairs_in_band(row0: np.ndarray, tolerance: np.ndarray, row1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs (K,), (K,) with |row1 - row0| <= tolerance (N,), in order of the first."""
    order = np.argsort(row1, kind="stable")
    rows = row1[order]
    begin = np.searchsorted(rows, row0 - tolerance, "left")
    count = np.maximum(np.searchsorted(rows, row0 + tolerance, "right") - begin, 0)
    first = np.repeat(np.arange(len(row0)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return first, order[np.repeat(begin, count) + within]


def _two_best(values: np.ndarray, group: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By group the largest value, its place (-1: the group is empty) and the second largest."""
    best = np.full(groups, _NO_SIMILARITY, values.dtype)
    np.maximum.at(best, group, values)
    place = np.full(groups, -1, np.int64)
    winners = np.flatnonzero(values == best[group])
    place[group[winners]] = winners
    others = values.copy()
    others[place[place >= 0]] = _NO_SIMILARITY
    second = np.full(groups, _NO_SIMILARITY, values.dtype)
    np.maximum.at(second, group, others)
    return best, place, second


def _none() -> Putative:
    index, values = np.zeros(0, np.int64), np.zeros(0, np.float32)
    return Putative(index, index, values, values, values)

"""Nearest neighbours among unit descriptors, looked for only where geometry allows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_99_OF_2

# Similarity of what is not there; no two unit vectors are less alike than -1.
_NOTHING = -1.0
# Gathering the descriptors of a pair costs about as much as multiplying so many.
_DENSE_FROM = 1 / 8


@dataclass(frozen=True, slots=True)
class Putative:
    """For keypoints of image 0 their nearest neighbour in image 1, right or wrong.

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
        """(M,) bool: neither has a better partner, so that these are one to one; exact ties are no match."""
        return np.asarray((self.similarity > self.second0) & (self.similarity > self.second1))

    def distinct(self, ratio: float) -> np.ndarray:
        """(M,) bool: the squared distance to the best is less than ratio^2 times that to the runner-up."""
        # The margin keeps two identical candidates, both at distance zero, from passing as distinct.
        return np.asarray((1.0 - self.similarity) + 1e-6 <= ratio * ratio * (1.0 - self.second0))

    def select(self, index: np.ndarray) -> Putative:
        """The matches of that index or mask."""
        return Putative(
            self.index0[index], self.index1[index], self.similarity[index], self.second0[index], self.second1[index]
        )


def nearest_anywhere(descriptors0: np.ndarray, descriptors1: np.ndarray) -> Putative:
    """Among all keypoints of two images, whose descriptors (N, D), (M, D) are of unit length."""
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        return _none()
    similarity = descriptors0 @ descriptors1.T
    rows, columns = np.arange(len(descriptors0)), np.arange(len(descriptors1))
    index1, index0 = similarity.argmax(axis=1), similarity.argmax(axis=0)
    best1, best0 = similarity[rows, index1], similarity[index0, columns]
    similarity[rows, index1] = _NOTHING
    second = similarity.max(axis=1)
    similarity[rows, index1] = best1
    similarity[index0, columns] = _NOTHING
    runner_up = similarity.max(axis=0)
    other = np.where(index0[index1] == rows, runner_up[index1], best0[index1])
    return Putative(rows, index1, best1, second, other)


def nearest_in_rows(
    left: np.ndarray,
    right: np.ndarray,
    descriptors_left: np.ndarray,
    descriptors_right: np.ndarray,
    row_tolerance: float,
    disparity_range: tuple[float, float],
) -> Putative:
    """Along the rows of a rectified pair.

    Args:
        left, right: (N, 2), (M, 2) keypoints.
        descriptors_left, descriptors_right: (N, D), (M, D) of unit length.
        row_tolerance: largest |v_left - v_right|, pixels.
        disparity_range: allowed u_left - u_right, pixels.
    """
    first, second = _pairs_in_band(left[:, 1], np.full(len(left), row_tolerance), right[:, 1])
    disparity = left[first, 0] - right[second, 0]
    allowed = (disparity >= disparity_range[0]) & (disparity <= disparity_range[1])
    return _nearest(descriptors_left, descriptors_right, first[allowed], second[allowed])


def nearest_in_ellipses(
    predicted: np.ndarray,
    covariance: np.ndarray,
    keypoints: np.ndarray,
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
) -> Putative:
    """Within the 99 % ellipse about a predicted place.

    Args:
        predicted: (N, 2) expected pixel coordinates in image 1.
        covariance: (N, 2, 2) of that, pixels squared, positive definite.
        keypoints: (M, 2) of image 1.
        descriptors0, descriptors1: (N, D), (M, D) of unit length.
    """
    reach = np.sqrt(CHI_SQUARE_99_OF_2 * covariance[:, 1, 1])
    first, second = _pairs_in_band(predicted[:, 1], reach, keypoints[:, 1])
    offset = keypoints[second] - predicted[first]
    # Rows and columns of the ellipse's box first: most pairs of a band are far away.
    close = np.abs(offset[:, 0]) <= np.sqrt(CHI_SQUARE_99_OF_2 * covariance[:, 0, 0])[first]
    first, second, offset = first[close], second[close], offset[close]
    inside = within_ellipses(offset, covariance[first])
    return _nearest(descriptors0, descriptors1, first[inside], second[inside])


def within_ellipses(offset: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(K,) bool, whether offsets (K, 2) lie in the 99 % ellipses of covariances (K, 2, 2)."""
    u, v = offset.T
    uu, uv, vv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(vv * u * u - 2.0 * uv * u * v + uu * v * v <= CHI_SQUARE_99_OF_2 * (uu * vv - uv * uv))


def _pairs_in_band(row0: np.ndarray, reach: np.ndarray, row1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs (K,), (K,) with |row1 - row0| <= reach (N,), in order of the first."""
    order = np.argsort(row1, kind="stable")
    rows = row1[order]
    begin = np.searchsorted(rows, row0 - reach, "left")
    count = np.maximum(np.searchsorted(rows, row0 + reach, "right") - begin, 0)
    first = np.repeat(np.arange(len(row0)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return first, order[np.repeat(begin, count) + within]


def _nearest(descriptors0: np.ndarray, descriptors1: np.ndarray, first: np.ndarray, second: np.ndarray) -> Putative:
    """Best and runner-up of every keypoint among the allowed pairs (K,), (K,), the first in ascending order."""
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


def _two_best(values: np.ndarray, group: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By group the largest value, its place (-1: the group is empty) and the second largest."""
    best = np.full(groups, _NOTHING, values.dtype)
    np.maximum.at(best, group, values)
    place = np.full(groups, -1, np.int64)
    winners = np.flatnonzero(values == best[group])
    place[group[winners]] = winners
    struck = values.copy()
    struck[place[place >= 0]] = _NOTHING
    second = np.full(groups, _NOTHING, values.dtype)
    np.maximum.at(second, group, struck)
    return best, place, second


def _none() -> Putative:
    index, values = np.zeros(0, np.int64), np.zeros(0, np.float32)
    return Putative(index, index, values, values, values)

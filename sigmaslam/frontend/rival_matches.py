"""Matches that one pair of images cannot tell from others as good: of a scene that repeats itself, or upside down."""

import numpy as np

from sigmaslam.frontend.types import Features

# Keypoints resemble a point alike if their similarities differ by no more. Of the probable matches of streets, halls,
# facades and boats at most 0.17 have another as alike (SIFT and ORB 0.34), of checkerboard and wallpaper 0.9 (ORB 0.8
# and 0.4).
_ALIKE = 0.03
# And are other places, pixels, from here on: nearer ones may be the same.
_APART = 8.0
# A scene repeats itself if this share of the matches have a rival.
_REPEATED = 0.5


def count_rivals(features0: Features, features1: Features, index0: np.ndarray, index1: np.ndarray) -> np.ndarray:
    """How many other places of image 1 resemble the keypoints of matches as much as the matched ones.

    Args:
        features0, features1: of either image.
        index0, index1: (M,) which of them are matched.
    Returns:
        (M,) number of keypoints elsewhere in image 1 that are alike.
    """
    similarity = features0.descriptors[index0] @ features1.descriptors.T
    matched = similarity[np.arange(len(index0)), index1]
    offset = features1.keypoints[None] - features1.keypoints[index1][:, None]
    elsewhere = (offset**2).sum(axis=2) > _APART**2
    return np.asarray((elsewhere & (similarity >= matched[:, None] - _ALIKE)).sum(axis=1))


def share_with_rivals(probability: np.ndarray, rivals: np.ndarray, share: float) -> np.ndarray:
    """Probabilities (M,) of matches in a scene that repeats itself; as they are where it does not.

    Matches one period aside agree as well with each other as the right ones, so that nothing but chance speaks for
    those that were found: each place has the same share.

    Args:
        probability: (M,) without rivals.
        rivals: (M,) as of `count_rivals`.
        share: of the probable matches, that have one.
    """
    if share < _REPEATED:
        return probability
    # What looks unique among them goes with its neighbours.
    return np.asarray(probability / (1.0 + np.maximum(rivals, np.median(rivals))), np.float32)

"""Which keyframes show the place that a view shows."""

import numpy as np

from sigmaslam.frontend import StereoView
from sigmaslam.slam.appearance import AppearanceIndex
from sigmaslam.slam.keyframe import KnownKeyframe

# Descriptors of a keyframe and of a view that vote on whether they show the same place.
_VOTERS = 300
VOTING = 60
"""Keyframes that vote, of thousands that are known: half a millisecond each."""


def retrieve(
    view: StereoView, count: int, among: list[KnownKeyframe], appearance: AppearanceIndex
) -> list[KnownKeyframe]:
    """Up to `count` keyframes that look most like the view, best first; the latest where nothing tells them apart.

    Args:
        count: at most so many.
        among: the keyframes, by their numbers upwards.
        appearance: of these, and perhaps of others.
    """
    latest_first = most_alike(view, among, appearance)[::-1]
    return [latest_first[k] for k in np.argsort(-count_votes(view, latest_first), kind="stable")[:count]]


def most_alike(view: StereoView, among: list[KnownKeyframe], appearance: AppearanceIndex) -> list[KnownKeyframe]:
    """The keyframes that look most like the view by one vector each, at most `VOTING`, in their order."""
    if len(among) <= VOTING:
        return among
    alike = set(appearance.rank(view, VOTING, {keyframe.id for keyframe in among}))
    return [keyframe for keyframe in among if keyframe.id in alike]


def count_votes(view: StereoView, among: list[KnownKeyframe]) -> np.ndarray:
    """(K,) mutual nearest descriptors of the view and each keyframe; zero without descriptors."""
    wanted = view.features.descriptors[:_VOTERS]
    votes = np.zeros(len(among), np.int64)
    for k, keyframe in enumerate(among):
        similarity = keyframe.descriptors[:_VOTERS] @ wanted.T
        if similarity.size and wanted.shape[1]:
            forward, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
            votes[k] = (back[forward] == np.arange(len(forward))).sum()
    return votes


def closest_pair(poses: np.ndarray) -> tuple[int, int]:
    """The two of poses (K, 4, 4) that are closest to each other in place and direction, the earlier one first."""
    places, directions = poses[:, :3, 3], poses[:, :3, 2]
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    spread = max(float(np.median(distance)), 1e-12)
    distance = distance / spread + np.linalg.norm(directions[:, None] - directions[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    one, other = (int(k) for k in np.unravel_index(np.argmin(distance), distance.shape))
    return min(one, other), max(one, other)

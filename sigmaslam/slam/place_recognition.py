"""Which keyframes show the place that a view shows."""

from __future__ import annotations

import numpy as np

from sigmaslam.frontend import StereoView
from sigmaslam.slam.keyframe import Keyframe

# Descriptors of a keyframe and of a view that vote on whether they show the same place.
_VOTERS = 300


def retrieve(view: StereoView, count: int, among: list[Keyframe]) -> list[Keyframe]:
    """Up to `count` keyframes that look most like the view, best first; the latest where nothing tells them apart."""
    latest_first = among[::-1]
    order = np.argsort(-count_votes(view, latest_first), kind="stable")
    return [latest_first[k] for k in order[:count]]


def count_votes(view: StereoView, among: list[Keyframe]) -> np.ndarray:
    """(K,) mutual nearest descriptors of the view and each keyframe; zero without descriptors."""
    wanted = view.features.descriptors[:_VOTERS]
    votes = np.zeros(len(among), np.int64)
    for k, keyframe in enumerate(among):
        similarity = keyframe.view.features.descriptors[:_VOTERS] @ wanted.T
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

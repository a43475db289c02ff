"""Which keyframes show the place that a view shows."""

from __future__ import annotations

import numpy as np

from sigmaslam.frontend import StereoView
from sigmaslam.slam.appearance import AppearanceIndex
from sigmaslam.slam.keyframe import KnownKeyframe

# Descriptors of a keyframe and of a view that vote on whether they show the same place; of more keyframes only so
# many vote, which look most like the view.
_VOTERS, _VOTING = 300, 60


def retrieve(
    view: StereoView, count: int, among: list[KnownKeyframe], appearance: AppearanceIndex
) -> list[KnownKeyframe]:
    """Up to `count` keyframes that look most like the view, by mutual nearest descriptors, best first.

    Args:
        view: the current one.
        count: at most so many.
        among: the keyframes, by their numbers upwards.
        appearance: of these, and perhaps of others.
    """
    if len(among) > _VOTING:
        alike = set(appearance.rank(view, _VOTING, [keyframe.id for keyframe in among]))
        among = [keyframe for keyframe in among if keyframe.id in alike]
    wanted = view.features.descriptors[:_VOTERS]
    if not wanted.shape[1]:
        return among[-count:][::-1]
    votes = []
    for keyframe in among:
        similarity = keyframe.descriptors[:_VOTERS] @ wanted.T
        if not similarity.size:
            votes.append(0)
            continue
        forward, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
        votes.append(int((back[forward] == np.arange(len(forward))).sum()))
    order = np.argsort(-np.array(votes, np.int64), kind="stable")[:count]
    return [among[k] for k in order]


def closest_pair(poses: np.ndarray) -> tuple[int, int]:
    """The two of poses (K, 4, 4) that are closest to each other in place and direction, the earlier one first."""
    places, directions = poses[:, :3, 3], poses[:, :3, 2]
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    spread = max(float(np.median(distance)), 1e-12)
    distance = distance / spread + np.linalg.norm(directions[:, None] - directions[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    one, other = (int(k) for k in np.unravel_index(np.argmin(distance), distance.shape))
    return min(one, other), max(one, other)

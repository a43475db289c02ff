"""Thousands of keyframes beside the few whose poses are remembered together: each hangs at one of these."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sigmaslam.slam.keyframe import HangingKeyframe, Keyframe
from sigmaslam.slam.packed_view import PackedView
from sigmaslam.slam.place_recognition import closest_pair

# Features that are kept of each: with so many, two of ten views of a flying camera two keyframes apart are not found
# that are with all 1,200, and none of a car's.
_FEATURES = 500


class HangingKeyframes:
    """Keyframes at the neighbours that they hang at.

    Attributes:
        most: at one neighbour; of the two that are closest to each other the later one is forgotten.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._by_id: dict[int, HangingKeyframe] = {}

    def __iter__(self) -> Iterator[HangingKeyframe]:
        """By the order in which they began to hang."""
        return iter(self._by_id.values())

    def add(self, keyframe: HangingKeyframe) -> None:
        """Takes one of a map."""
        self._by_id[keyframe.id] = keyframe

    def hand_over(self, leaving: Keyframe, heir: int, step: np.ndarray, covariance: np.ndarray) -> list[int]:
        """Hangs a keyframe whose pose is about to be forgotten, and what hangs at it, at another one.

        Args:
            leaving: the keyframe.
            heir: number of the other one.
            step: (4, 4) T_heir_leaving.
            covariance: (6, 6) of that, perturbed from the left in the heir.
        Returns:
            Numbers of those that are forgotten for it.
        """
        moved = [each for each in self if each.origin == leaving.id]
        if self.most:
            packed = PackedView.of(leaving.view, _FEATURES)
            still = np.zeros((6, 6))
            moved.append(HangingKeyframe(leaving.id, leaving.timestamp, packed, leaving.id, np.eye(4), still))
        self._by_id |= {each.id: each.handed_over(heir, step, covariance) for each in moved}
        group = sorted((each for each in self if each.origin == heir), key=lambda each: each.id)
        forgotten = [] if self.most else [leaving.id]
        while len(group) > self.most:
            later = closest_pair(np.array([each.step for each in group]))[1]
            forgotten.append(group.pop(later).id)
            del self._by_id[forgotten[-1]]
        return forgotten

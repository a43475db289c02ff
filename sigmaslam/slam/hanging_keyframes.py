"""Thousands of keyframes beside the few whose poses are remembered together: each hangs at one of these."""

from collections import Counter

import numpy as np

from sigmaslam.slam.keyframe import HangingKeyframe, Keyframe
from sigmaslam.slam.packed_view import PackedView
from sigmaslam.slam.place_recognition import closest_pair

# Features that are kept of each: with so many, two of ten views of a flying camera two keyframes apart are not found
# that are with all 1,200, and none of a car's.
_FEATURES = 500


def hang_over(
    hanging: dict[int, HangingKeyframe],
    most: int,
    leaving: Keyframe,
    heir: int,
    step: np.ndarray,
    covariance: np.ndarray,
) -> list[int]:
    """Hangs a keyframe whose pose is about to be forgotten, and what hangs at it, at another one.

    Args:
        hanging: all of them by their numbers; changed.
        most: of all; of the two that are closest to each other where most hang the later one is forgotten.
        heir: number of the other one.
        step: (4, 4) T_heir_leaving.
        covariance: (6, 6) of that, perturbed from the left in the heir.
    Returns:
        Numbers of those that are forgotten for it.
    """
    packed = PackedView.of(leaving.view, _FEATURES)
    own = HangingKeyframe(leaving.id, leaving.timestamp, packed, leaving.id, leaving.step, leaving.covariance)
    hanging[leaving.id] = own
    moved = [each for each in hanging.values() if each.origin == leaving.id]
    hanging |= {each.id: each.handed_over(heir, step, covariance) for each in moved}
    forgotten = []
    while len(hanging) > most:
        origin = Counter(each.origin for each in hanging.values()).most_common(1)[0][0]
        group = sorted(each.id for each in hanging.values() if each.origin == origin)
        forgotten.append(group[closest_pair(np.array([hanging[id].step for id in group]))[1]])
        del hanging[forgotten[-1]]
    return forgotten

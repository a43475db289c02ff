"""A clock that was set, or frames that are missing: a long interval alone does not tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sigmaslam.estimation.constant_velocity import dead_reckoning
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.frontend import StereoView
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.keyframe import Keyframe
from sigmaslam.slam.landmark_places import seen_from
from sigmaslam.slam.localisation import Localiser, Prediction
from sigmaslam.slam.stopwatch import Stopwatch
from sigmaslam.two_view.scene_pose import is_rival, see_the_same

Found = tuple[GuidedMatches, FrameFit | None]


def follow_either(
    localiser: Localiser, frame: Frame, keyframes: list[Keyframe], prediction: Prediction, clock: Stopwatch
) -> Found:
    """`Localiser.follow` by both times that a frame may have."""
    return _try_both(localiser, prediction, partial(localiser.follow, frame, keyframes, clock=clock))


def localise_either(
    localiser: Localiser, view: StereoView, keyframes: list[StereoView], guided: bool, clock: Stopwatch
) -> Found:
    """`Localiser.localise` by both times; where neither gives a pose the prediction spans both."""
    prediction = Prediction.of(localiser.window, localiser.motion)
    found = _try_both(localiser, prediction, partial(localiser.localise, view, keyframes, guided=guided, clock=clock))
    if found[1] is None and localiser.frame_clock.late and dead_reckoning(localiser.motion) is None:
        localiser.motion.doubt_time(localiser.frame_clock.late)
    return found


def _try_both(localiser: Localiser, prediction: Prediction, search: Callable[[Prediction], Found]) -> Found:
    """What is found near the prediction, and near that of a frame which is not late, where that may be.

    The pose that more matches agree with, and the motion that led there, are kept; where both are the same, the motion
    that is closer. The other pose is kept beside it where it is a rival.
    """
    motion = localiser.motion
    matches, fit = search(prediction)
    late = localiser.frame_clock.late
    if late == 0.0 or dead_reckoning(motion) is not None:
        return matches, fit
    as_stamped = motion.state, motion.widened
    motion.go_back(late)
    earlier = Prediction.of(localiser.window, motion)
    others, other = search(earlier)
    is_same = fit is not None and other is not None and _are_same(localiser, matches, fit, other)
    if is_same:
        goes_back = earlier.squared_departure(other.pose) < prediction.squared_departure(fit.pose)
    else:
        goes_back = other is not None and (fit is None or other.count > fit.count)
    if goes_back:
        matches, fit, other = others, other, fit
    else:
        motion.restore(*as_stamped)
    if fit is not None and other is not None and not is_same and is_rival(other.count, fit.count):
        matches = replace(matches, rival=other.pose)
    return matches, fit


def _are_same(localiser: Localiser, matches: GuidedMatches, fit: FrameFit, other: FrameFit) -> bool:
    """Whether two poses see most landmarks of the first one at the same places."""
    rows = matches.views.landmark[fit.inliers]
    here, there = (seen_from(localiser.window, rows, each.pose)[:, :2] for each in (fit, other))
    return see_the_same(np.linalg.norm(here - there, axis=1))

"""A clock that was set, or frames that are missing: a long interval alone does not tell."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.landmark_places import seen_apart
from sigmaslam.slam.localisation import Localiser, Prediction
from sigmaslam.slam.rig_change import RigChange
from sigmaslam.two_view.scene_pose import is_rival, see_the_same

Found = tuple[GuidedMatches, FrameFit | None, RigChange | None]


def by_times(localiser: Localiser, localise: Callable[[], Found]) -> Found:
    """What is found by the motion as it was predicted and, where the frame may not be late, as it was before.

    The pose that more matches agree with, and the motion that led there, are kept; where both are the same, the motion
    that is closer. The other pose is kept beside it where it is a rival. Without a pose the motion spans both times.
    """
    motion, window, late = localiser.motion, localiser.window, localiser.frame_clock.late
    matches, fit, change = localise()
    if late == 0.0 or change is not None or dead_reckoning(motion) is not None or not len(window):
        return matches, fit, change
    as_stamped = motion.state, motion.widened
    go_back(motion, 0.0)
    prediction = Prediction.of(window, motion)
    go_back(motion, late)
    earlier = Prediction.of(window, motion)
    others, other, _ = localise()
    if fit is None or other is None:
        is_same, goes_back = False, fit is None and other is not None
    elif is_same := see_the_same(seen_apart(window, matches.views.landmark[fit.inliers], fit.pose, other.pose)):
        goes_back = earlier.squared_departure(other.pose) < prediction.squared_departure(fit.pose)
    else:
        goes_back = other.count > fit.count
    if goes_back:
        matches, fit, other = others, other, fit
    else:
        motion.restore(*as_stamped)
    if fit is None:
        # Any moment in between is as likely: a camera is in no place that it left before the earlier one.
        go_back(motion, 0.5 * late)
        motion.doubt_time(late / np.sqrt(12.0))
    elif other is not None and not is_same and is_rival(other.count, fit.count):
        matches = replace(matches, rival=other.pose)
    return matches, fit, None


def go_back(motion: MotionFilter, seconds: float) -> None:
    """Predicts an earlier moment, no more certain than the later one, and no longer widened."""
    motion.widen(1.0 / motion.widened)
    motion.step = se3_exp(-motion.way(seconds)) @ motion.step

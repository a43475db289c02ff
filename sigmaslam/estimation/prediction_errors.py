"""Whether a pose that images gave departs from its prediction by more than the motion allows, and why."""

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_95, CHI_SQUARE_999, CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.geometry.se3 import se3_inverse, se3_log


def time_error(motion: MotionFilter, step: np.ndarray, interval: float, expected: bool = False) -> float:
    """By how many frames an image seems to be later than its stamp; 0 where the motion's noise explains its pose.

    A pose that departs from the prediction as the velocity goes, by half a frame's way or more, is of another moment: a
    real acceleration does not do that within a frame.

    Args:
        motion: as it was predicted.
        step: (4, 4) T_keyframe_camera as the image shows it.
        interval: of the frames, seconds.
        expected: the driver has delivered such an image before: less must speak for another one.
    """
    least = (CHI_SQUARE_95 if expected else CHI_SQUARE_999)[1]
    departure, along = se3_log(step @ se3_inverse(motion.step)), motion.way(interval)
    weighted = np.linalg.lstsq(motion.predicted_covariance, np.column_stack([departure, along]), rcond=1e-14)[0]
    (whole, across), (_, visible) = np.stack([departure, along]) @ weighted
    if visible <= least:
        return 0.0
    frames, explained = float(across / visible), across**2 / visible
    # What the time does not explain is the motion's noise, or little.
    left = max(CHI_SQUARE_999[5], (1.0 - ACCEPTANCE.time_share) * whole)
    seen = explained > least and whole - explained < left
    return frames if seen and abs(frames) >= ACCEPTANCE.time_error else 0.0


def surprise(motion: MotionFilter, step: np.ndarray) -> float:
    """By what the prediction's variances are too small where a pose (4, 4) T_keyframe_camera is right; 1 or more.

    A prediction that the images contradict drags the pose along, and says nothing of it.
    """
    departure = se3_log(step @ se3_inverse(motion.step))
    squared = float(departure @ np.linalg.lstsq(motion.step_covariance, departure, rcond=1e-14)[0])
    return squared / len(departure) if squared > CHI_SQUARE_9999_OF_6 else 1.0

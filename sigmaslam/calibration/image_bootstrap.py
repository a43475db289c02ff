"""Sigmas of a calibration beside those of a bootstrap over its images."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sigmaslam.calibration.board_bundle import Rig, solve_bundle
from sigmaslam.calibration.calibrate import BoardCalibration
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.se3 import se3_inverse, se3_log

# The standard deviation of so many values is itself known to 10 %.
RESAMPLES = 50


def bootstrap_rigs(
    result: BoardCalibration, resamples: int, seed: int, done: Callable[[], object] = lambda: None
) -> np.ndarray:
    """(R, P) parameters minus those of the calibration, of images drawn with replacement.

    A resample that leaves a parameter open is left out. `done` is called after each.
    """
    rng, images = np.random.default_rng(seed), len(result.names)
    differences = []
    for _ in range(resamples):
        weights = rng.multinomial(images, np.full(images, 1.0 / images)).astype(float)
        try:
            rig = solve_bundle(result.rig, result.bundle.poses, result.corners, weights).rig
        except CalibrationError:
            continue
        finally:
            done()
        differences.append(_difference(rig, result.rig))
    return np.array(differences).reshape(-1, len(result.rig.names))


def widened(result: BoardCalibration, differences: np.ndarray) -> BoardCalibration:
    """The calibration with larger sigmas where resamples of its images scatter more.

    The jackknife is linear. A coefficient that few images tell moves much farther where a resample lacks them all, so
    that the resamples have heavy tails: their standard deviation is then far above half their central 68 %, and no
    sigma is both. The geometric mean of it and the jackknife's is taken; correlations stay.

    Args:
        result: with the covariance of `rig_covariance`.
        differences: (R, P) of `bootstrap_rigs`.
    """
    if len(differences) < 2:
        return result
    factor = np.sqrt(np.maximum(differences.std(axis=0) / result.sigmas, 1.0))
    return replace(result, covariance=result.covariance * np.outer(factor, factor))


def _difference(rig: Rig, other: Rig) -> np.ndarray:
    one, two = (
        np.array([value for eye in each.eyes for value in (eye.fx, eye.fy, eye.cx, eye.cy, *eye.distortion)])
        for each in (rig, other)
    )
    if len(rig.eyes) == 1:
        return one - two
    return np.r_[one - two, se3_log(rig.T_left_right @ se3_inverse(other.T_left_right))]

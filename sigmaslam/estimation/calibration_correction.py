"""A window corrects its calibration where evidence speaks, and offsets beyond their prior."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS, TURNS
from sigmaslam.estimation.calibration_evidence import HYPOTHESES, CalibrationEvidence, Cause

if TYPE_CHECKING:
    from sigmaslam.estimation.keyframe_window import KeyframeWindow

# An error of the calibration beyond so many standard deviations of its prior is none that calibrations usually have.
_CREDIBLE = 4.0
# Boards are held within arm's reach: there depths are right, whatever else a calibration has wrong, metres.
_REACH = 0.5


def change_rig(window: KeyframeWindow, offset: float) -> None:
    """The right camera was bumped, and disparities are larger by an offset; no keyframe is in the window.

    The bump may have turned the camera, too.
    """
    assert not len(window)
    window.expected[0] = window.posterior.calibration[0] + offset
    window.exceeded[:], window.board_disparity = False, None
    turns = np.isin(ERRORS, TURNS)
    turned = window.calibration.widened(turns * offset)
    # Of poses after it alone, and where a file claims that there is no error at all, too.
    common, rows = window.posterior.common.copy(), np.flatnonzero(turns)
    common[rows, rows] = np.hypot(common[rows, rows], offset)
    state = replace(window.posterior, calibration=window.expected.copy(), common=common)
    window.prior = window.posterior = state
    window.calibration = turned
    window.evidence = CalibrationEvidence(turned, window.camera.fx, window.graphs.condition, window.expected)


def judge_calibration(window: KeyframeWindow) -> None:
    """What is wrong with it, which offset poses stand on, and whether that is larger than calibrations usually have."""
    _correct_calibration(window)
    prior, before = window.calibration, window.held_offset
    window.held_offset = before.following(window.posterior)
    departure = np.abs(window.posterior.calibration - window.expected)
    beyond = prior.estimated & (prior.sigma > 0.0) & (departure > _CREDIBLE * prior.sigma)
    window.exceeded = beyond | (window.exceeded & (window.expected == window.evidence.expected))
    held = window.held_offset.value
    if not window.exceeded[0]:
        if window.board_disparity is not None:
            window.board_disparity = None
            _set_error(window, ERRORS.index("baseline"), 0.0, 0.0)
    elif held is not None and (window.board_disparity is None or window.held_offset != before):
        _move_baseline(window, held - float(window.expected[0]))
    window.worse = window.evidence.worse_by(window.causes)


def _correct_calibration(window: KeyframeWindow) -> None:
    """Moves considered errors to the mean of all hypotheses, and makes them as uncertain as these differ.

    Where nothing is wrong an error is zero, and as uncertain as usual, as poses come out best so. The disparity offset
    is estimated anyway; it is expected where a yaw has it.
    """
    window.causes = window.evidence.weigh()
    window.expected = window.evidence.expected.copy()
    for name, moved in HYPOTHESES.items():
        k = ERRORS.index(name)
        if window.calibration.estimated[k] or window.calibration.sigma[k] == 0.0:
            continue
        cause = window.causes.get(name, Cause())
        mean = cause.probability * cause.mean
        spread = np.sqrt(cause.probability * (cause.variance + cause.mean**2) - mean**2)
        if (window.corrected[:, k] != (mean, spread)).any():
            _set_error(window, k, mean, spread)
        if "offset" in moved:
            window.expected[0] += mean


def _move_baseline(window: KeyframeWindow, offset: float) -> None:
    """Takes the baseline for one that made up for an offset when the rig was calibrated, as uncertain as that."""
    if window.board_disparity is None:
        seen = float(np.median(window.landmarks.estimate[:, 2]))
        window.board_disparity = max(window.camera.focal_baseline / _REACH, seen)
    change = -offset / window.board_disparity
    _set_error(window, ERRORS.index("baseline"), change, change)


def _set_error(window: KeyframeWindow, index: int, mean: float, spread: float) -> None:
    """Gives a considered error another mean, and a standard deviation more beside its usual one."""
    variance = window.calibration.covariance.copy()
    variance[index, index] += spread**2 - window.corrected[1, index] ** 2
    after = replace(window.calibration, covariance=variance)
    window.prior, _ = window.prior.with_error(index, mean, window.calibration, after)
    window.posterior, step = window.posterior.with_error(index, mean, window.calibration, after)
    window.landmarks.estimate += window.landmarks.dependence @ step
    window.calibration, window.corrected[:, index] = after, (mean, spread)

"""A window corrects its calibration where evidence speaks, and offsets beyond their prior."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS, SHOWN, TURNS
from sigmaslam.estimation.calibration_evidence import HOPELESS, HYPOTHESES, CalibrationEvidence
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.geometry.se3 import se3_exp

if TYPE_CHECKING:
    from sigmaslam.estimation.keyframe_window import KeyframeWindow

# An error of the calibration beyond so many standard deviations of its prior is none that calibrations usually have.
_CREDIBLE = 4.0
# A frame is asked where its variance of the offset is so much smaller than the window's: by half of the sigma. It
# contradicts where it departs by so many of the window's, as one calibration in eight; of 1, 1.5, 2 this serves best.
_FAR_BETTER, _CONTRADICTS = 0.25, 1.5
# Boards are held within arm's reach: there depths are right, whatever else a calibration has wrong, metres.
_REACH = 0.5
_BASELINE = np.array([ERRORS.index("baseline")])


def change_rig(window: "KeyframeWindow", offset: float) -> None:
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


def foresee(
    window: "KeyframeWindow", fit: FrameFit, step: np.ndarray, step_covariance: np.ndarray, growth: float
) -> bool:
    """Whether a frame, which knows the offset far better than the window, has another one, or is sure of what is wrong.

    What it finds is foreseen until a keyframe comes, as the frame has it that was surest; a lens of both eyes beyond
    four sigmas alone, as one image of a scene that grows is sure of one within three.

    Args:
        step, step_covariance: as of `KeyframeWindow.add_keyframe`.
        growth: by what the variances of the frame's views would be larger in a keyframe.
    """
    known, joint = window.posterior, fit.joint
    departure, variance = fit.calibration[0] - known.calibration[0], known.covariance[0, 0]
    if joint.covariance[0, 0] >= _FAR_BETTER * variance:
        return False
    poses = se3_exp(joint.step[CALIBRATION_SIZE:-6].reshape(-1, 6)) @ known.poses
    about = replace(known, calibration=fit.calibration, poses=np.concatenate([poses, fit.pose[None]]))
    found = window.evidence.weigh_frame(about, step, step_covariance, joint.information / growth, joint.score / growth)
    credible = {k: each for k, each in found.items() if k != "lens" or each.mean**2 > _CREDIBLE**2 * each.variance}
    new = {k: each for k, each in credible.items() if k not in window.causes}
    for name, cause in new.items():
        window.foreseen[name] = max(window.foreseen.get(name, cause), cause, key=lambda each: each.probability)
    is_sure = any(cause.probability > 1.0 - HOPELESS for cause in new.values())
    return is_sure or bool(departure**2 > _CONTRADICTS**2 * variance)


def judge_calibration(window: "KeyframeWindow") -> None:
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
            _set_errors(window, _BASELINE, np.zeros(1), np.zeros(1))
    elif held is not None and (window.board_disparity is None or window.held_offset != before):
        _move_baseline(window, held - float(window.expected[0]))


def _correct_calibration(window: "KeyframeWindow") -> None:
    """Moves considered errors to what images show of all of them together, and widens those that causes move.

    One error alone would stand for others, too. The disparity offset is estimated anyway; it is expected where a yaw
    has it. A mean that creeps from keyframe to keyframe is off by as much as it moved, at least.
    """
    before, window.causes, window.foreseen = window.causes, window.evidence.weigh(), {}
    window.expected = window.evidence.expected.copy()
    means, window.worse = window.evidence.beside(window.causes)
    spreads = np.zeros(len(ERRORS))
    for name, cause in window.causes.items():
        of_cause, moved = cause.probability * cause.mean, cause.mean - before.get(name, cause).mean
        spread = cause.probability * (cause.variance + moved**2 + cause.mean**2) - of_cause**2
        spreads[ERRORS.index(name)] = np.sqrt(spread)
        if name != "offset" and "offset" in HYPOTHESES[name]:
            window.expected[0] += of_cause
    moves = np.isin(ERRORS, SHOWN) & ~window.calibration.estimated & (window.calibration.sigma > 0.0)
    _set_errors(window, np.flatnonzero(moves), means[moves], spreads[moves])


def _move_baseline(window: "KeyframeWindow", offset: float) -> None:
    """As likely as not the baseline made up for an offset when the rig was calibrated: half of that, as uncertain."""
    if window.board_disparity is None:
        seen = float(np.median(window.landmarks.estimate[:, 2]))
        window.board_disparity = max(window.camera.focal_baseline / _REACH, seen)
    change = np.array([-offset / window.board_disparity])
    _set_errors(window, _BASELINE, 0.5 * change, change)


def _set_errors(window: "KeyframeWindow", index: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> None:
    """Gives considered errors other means (K,), and standard deviations (K,) more beside their usual ones."""
    variance = window.calibration.covariance.copy()
    variance[index, index] += spread**2 - window.corrected[1, index] ** 2
    after = replace(window.calibration, covariance=variance)
    by_error = np.linalg.pinv(window.calibration.considered_factor)
    to_factor = by_error @ after.considered_factor
    window.prior, _ = window.prior.with_errors(index, mean, by_error, to_factor)
    window.posterior, step = window.posterior.with_errors(index, mean, by_error, to_factor)
    window.landmarks.estimate += window.landmarks.dependence @ step
    window.calibration, window.corrected[:, index] = after, (mean, spread)

"""Fixed-interval smoothing of the constant-velocity chain: what later frames say of the motion to earlier ones."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionState
from sigmaslam.estimation.gaussian import matrix_root, regression
from sigmaslam.geometry.se3 import nearest_rigid, se3_adjoint, se3_exp, se3_inverse, se3_log, skew


@dataclass(frozen=True, slots=True)
class MotionLink:
    """What the motion filter knew of one frame, relative to the last keyframe before it.

    Attributes:
        timestamp: seconds.
        predicted: before its images.
        filtered: with them; the same where they gave no pose.
    """

    timestamp: float
    predicted: MotionState
    filtered: MotionState


@dataclass(frozen=True, slots=True)
class SmoothedMotion:
    """Successive frames that hang at one keyframe, each given all of them.

    Attributes:
        step: (N, 4, 4) T_keyframe_camera.
        covariance: (N, 6, 6) of it, perturbed from the left in the keyframe.
    """

    step: np.ndarray
    covariance: np.ndarray


def smooth_motion(chain: list[MotionLink]) -> SmoothedMotion:
    """The backward pass of Rauch, Tung and Striebel (1965), with the error state of the filter.

    Args:
        chain: frames in the order of time.
    """
    if not chain:
        return SmoothedMotion(np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
    states = [chain[-1].filtered]
    for link, later in zip(chain[-2::-1], chain[:0:-1], strict=True):
        here, predicted, after = link.filtered, later.predicted, states[-1]
        ends = predicted.carried is None and len(here.twist) != len(predicted.twist)
        ends |= np.trace(here.covariance[3:6, 3:6]) > 0.3**2  # not linear: the pass would swing, its covariance grow
        if ends or not here.covariance.any():  # the inertial sensor died, or the keyframe, whose frame all are in
            states.append(here)
            continue
        carried = predicted.carried
        if carried is None:
            carried = here.covariance @ _transition(here, later.timestamp - link.timestamp).T
        departure = np.r_[se3_log(after.step @ se3_inverse(predicted.step)), np.zeros(len(predicted.covariance) - 6)]
        spread = predicted.covariance
        if len(after.twist) == len(predicted.twist):
            departure[6:] = after.twist - predicted.twist
        else:  # the inertial sensor began there: poses alone are common
            departure, carried, spread = departure[:6], carried[:, :6], spread[:6, :6]
        gain, size = regression(carried, spread), len(departure)
        move = gain @ departure
        # Of a motion that is hardly known, predicted by sigma points, the difference may be negative somewhere.
        root = matrix_root(here.covariance + gain @ (after.covariance[:size, :size] - spread) @ gain.T)
        step = nearest_rigid(se3_exp(move[:6]) @ here.step)
        states.append(MotionState(step, here.twist + move[6:], root @ root.T))
    states.reverse()
    return SmoothedMotion(
        np.array([state.step for state in states]), np.array([state.covariance[:6, :6] for state in states])
    )


def _transition(state: MotionState, seconds: float) -> np.ndarray:
    """(12, 12) derivative of the state after so many seconds of constant velocity by the state now."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = seconds * skew(state.twist[3:])
    turn[:3, 3:] = seconds * skew(state.twist[:3])
    # The left Jacobian of SE(3), to the second order in the turn from frame to frame.
    jacobian = np.eye(6) + turn / 2 + turn @ turn / 6
    slope = np.eye(12)
    slope[:6, 6:] = seconds * se3_adjoint(state.step) @ jacobian
    return slope

"""The disparity offset that published poses stand on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.estimation.calibration_errors import CalibrationPrior
from sigmaslam.estimation.held_offset import HeldOffset
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log

PRIOR = CalibrationPrior.independent(np.array([0.5]), "offset")


def state(offset: float, sigma: float, keyframes: int = 2) -> WindowState:
    """A window that knows its offset so well."""
    grown = WindowState.initial(PRIOR)
    for _ in range(keyframes):
        grown = grown.grow(np.eye(4), np.eye(6), np.zeros(CALIBRATION_SIZE))
    covariance = grown.covariance.copy()
    covariance[0, 0] = sigma**2
    return replace(grown, calibration=np.r_[offset, np.zeros(CALIBRATION_SIZE - 1)], covariance=covariance)


def test_a_pose_for_another_offset_is_the_mean_given_that_offset():
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(7, 7))
    covariance, pose = root @ root.T, se3_exp(rng.normal(size=6))
    placed, spread = HeldOffset(0.3).place(pose, 0.29, covariance, slice(1, 7))
    # The same as a measurement of the offset without noise.
    gain = covariance[:, :1] @ np.linalg.inv(covariance[:1, :1])
    given = (gain * 0.01)[1:, 0]
    np.testing.assert_allclose(se3_log(placed @ se3_inverse(pose)), given, rtol=1e-9)
    # An alignment that errs alike everywhere by a hundredth of a pixel, as much as was moved, is no part of it.
    np.testing.assert_allclose(spread, 2.0 * np.outer(given, given), rtol=1e-9)


def test_nothing_is_held_before_a_second_keyframe():
    held = HeldOffset().following(state(0.4, 0.01, keyframes=1))
    pose = np.eye(4)
    assert held.value is None
    assert held.place(pose, 0.4, np.eye(7), slice(1, 7))[0] is pose


def test_it_is_held_while_the_images_agree_and_follows_as_far_as_they_do_not():
    held = HeldOffset(0.3, is_moving=False)
    for estimate in (0.31, 0.285, 0.315):
        held = held.following(state(estimate, 0.01))
        assert (held.value, held.is_moving) == (0.3, False)
    held = held.following(state(0.35, 0.01))
    assert held.value == pytest.approx(0.33)
    assert held.is_moving

"""The disparity offset that published poses stand on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.estimation.calibration_errors import CalibrationPrior
from sigmaslam.estimation.held_offset import HeldOffset
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log

PRIOR = CalibrationPrior.independent(np.r_[0.5, np.zeros(11)], "offset")


def state(offset: float, sigma: float, considered: float = 0.0, keyframes: int = 2) -> WindowState:
    """A window that knows its offset so well by matches, and so badly for what is considered."""
    grown = WindowState.initial(PRIOR)
    for _ in range(keyframes):
        grown = grown.grow(np.eye(4), np.eye(6), np.zeros(12))
    covariance, common = grown.covariance.copy(), grown.common.copy()
    covariance[0, 0], common[0, 1] = sigma**2, considered
    return replace(grown, calibration=np.r_[offset, np.zeros(11)], covariance=covariance, common=common)


def test_a_pose_for_another_offset_is_the_mean_given_that_offset():
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(7, 7))
    covariance, pose = root @ root.T, se3_exp(rng.normal(size=6))
    placed, spread = HeldOffset(0.3).place(pose, 0.29, covariance[0, 0], covariance[1:, 0])
    # The same as a measurement of the offset without noise.
    gain = covariance[:, :1] @ np.linalg.inv(covariance[:1, :1])
    given = (gain * 0.01)[1:, 0]
    np.testing.assert_allclose(se3_log(placed @ se3_inverse(pose)), given, rtol=1e-9)
    np.testing.assert_allclose(spread, np.outer(given, given), rtol=1e-9)


def test_nothing_is_held_before_a_second_keyframe():
    held = HeldOffset().following(state(0.4, 0.01, keyframes=1), PRIOR, 0.0)
    pose = np.eye(4)
    assert held.value is None
    assert held.place(pose, 0.4, 1e-4, np.ones(6))[0] is pose


def test_it_is_held_while_the_images_agree_and_follows_as_far_as_they_do_not():
    held = HeldOffset(0.3, is_moving=False)
    for estimate in (0.31, 0.285, 0.315):
        held = held.following(state(estimate, 0.01), PRIOR, 0.0)
        assert (held.value, held.is_moving) == (0.3, False)
    held = held.following(state(0.35, 0.01), PRIOR, 0.0)
    assert held.value == pytest.approx(0.33)
    assert held.is_moving


def test_that_nothing_is_wrong_holds_until_the_evidence_speaks():
    # 0.06 px are six sigma of matches, but less than one of what else the calibration may be off by.
    unsure = HeldOffset().following(state(0.06, 0.01, considered=0.1), PRIOR, 0.0)
    assert 0.0 < unsure.value < 0.015
    sure = HeldOffset().following(state(0.6, 0.01, considered=0.1), PRIOR, 0.0)
    assert sure.value == pytest.approx(0.6, rel=1e-3)
    # Probability of an offset: 1 / (1 + N(0; 0.6, 0.2) / N(0; 0, 0.5)) by numerical integration of both.
    offsets = np.linspace(-5.0, 5.0, 200_001)
    likelihood = np.exp(-0.5 * ((offsets - 0.4) / 0.2) ** 2)
    prior = np.exp(-0.5 * (offsets / 0.5) ** 2)
    prior /= prior.sum()
    some, none = (prior * likelihood).sum(), likelihood[len(offsets) // 2]
    information = 1.0 / 0.2**2 + 1.0 / 0.5**2
    mean, sigma = 0.4 / 0.2**2 / information, information**-0.5
    half = HeldOffset().following(state(mean, sigma), PRIOR, 0.0)
    assert half.value == pytest.approx(mean * some / (some + none), rel=1e-6)


def test_after_a_bump_no_offset_is_more_likely_than_another():
    held = HeldOffset().following(state(2.05, 0.03), PRIOR, 2.0)
    assert held.value == pytest.approx(2.05)


def test_what_is_said_of_the_calibration_spans_the_estimate():
    calibration, covariance = HeldOffset(0.1).describe(np.r_[0.14, np.full(11, 0.5)], np.diag(np.full(12, 9e-4)))
    assert calibration[0] == 0.1
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.05)
    assert (calibration[1:] == 0.5).all()
    assert np.trace(covariance[1:, 1:]) == pytest.approx(11 * 9e-4)

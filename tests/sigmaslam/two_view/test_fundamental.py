"""The fundamental matrix: exact, more accurate than OpenCV's under noise, and its covariance holds."""

import cv2
import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.two_view.fundamental import (
    describe_epipole,
    epipolar_lines,
    epipoles,
    estimate_fundamental,
    uncertain_epipoles,
)
from sigmaslam.two_view.triangulation import TwoViews
from sigmaslam_benchmarks.tracking.two_view_geometry import fundamental_by_eight

K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])
SIGMA = 0.5


def pair() -> TwoViews:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_exp(np.array([0.03, -0.15, 0.05])), (-1.0, 0.1, 0.4)
    return TwoViews(K, K, T)


def matches(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(3.0, 12.0, count)
    return pair().project(np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * depth[:, None], depth]))


def unit(F: np.ndarray) -> np.ndarray:
    return F / np.linalg.norm(F) * np.sign(F[2, 1])


def estimate(pixels: np.ndarray, probability: np.ndarray | None = None):
    count = len(pixels)
    probability = np.ones(count) if probability is None else probability
    found = estimate_fundamental(
        pixels[:, :2], pixels[:, 2:], probability, np.tile(SIGMA**2 * np.eye(2), (count, 1, 1)), SIGMA
    )
    assert found is not None
    return found


def distance(F: np.ndarray, seed: int = 999) -> float:
    """Root mean square distance of exact points from their lines in both images, pixels."""
    pixels = matches(2000, seed)
    h0, h1 = (np.column_stack([pixels[:, k : k + 2], np.ones(2000)]) for k in (0, 2))
    one = (epipolar_lines(F, pixels[:, :2]) * h1).sum(axis=1)
    other = (epipolar_lines(F.T, pixels[:, 2:]) * h0).sum(axis=1)
    return float(np.sqrt((one**2 + other**2).mean() / 2.0))


def test_eight_points_and_the_estimate_are_exact():
    true, pixels = unit(pair().fundamental), matches(60, 0)
    # Eight points without noise leave OpenCV's normalised equations ill-conditioned.
    np.testing.assert_allclose(unit(fundamental_by_eight(pixels[:8, :2], pixels[:8, 2:])), true, atol=1e-6)
    np.testing.assert_allclose(unit(fundamental_by_eight(pixels[:, :2], pixels[:, 2:])), true, atol=1e-9)
    found = estimate(pixels)
    np.testing.assert_allclose(unit(found.F), true, atol=1e-9)
    assert found.inliers.all()
    assert abs(np.linalg.det(found.F)) < 1e-16


def test_epipoles_and_lines():
    F, (e0, e1) = pair().fundamental, epipoles(pair().fundamental)
    T = pair().T_1_0
    centre1_in_0, centre0_in_1 = K @ (-T[:3, :3].T @ T[:3, 3]), K @ T[:3, 3]
    np.testing.assert_allclose(np.cross(e0, centre1_in_0 / np.linalg.norm(centre1_in_0)), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(e1, centre0_in_1 / np.linalg.norm(centre0_in_1)), 0.0, atol=1e-12)
    pixels = matches(20, 1)
    lines = epipolar_lines(F, pixels[:, :2])
    np.testing.assert_allclose((lines * np.column_stack([pixels[:, 2:], np.ones(20)])).sum(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1.0)
    # All lines meet in the epipole.
    np.testing.assert_allclose(lines @ e1, 0.0, atol=1e-9)


def test_under_noise_it_is_better_than_opencv_s():
    ours, theirs = [], {method: [] for method in (cv2.FM_8POINT, cv2.USAC_ACCURATE, cv2.FM_LMEDS)}
    for seed in range(30):
        pixels = matches(120, seed) + np.random.default_rng((seed, 1)).normal(0.0, SIGMA, (120, 4))
        ours.append(distance(estimate(pixels).F))
        for method, found in theirs.items():
            found.append(distance(cv2.findFundamentalMat(pixels[:, :2], pixels[:, 2:], method, 1.0, 0.999, 2000)[0]))
    for found in theirs.values():
        assert np.median(ours) < np.median(found)


def test_wrong_matches_do_not_move_it():
    pixels = matches(200, 3) + np.random.default_rng(4).normal(0.0, SIGMA, (200, 4))
    wrong = np.arange(200) < 60
    spoiled = pixels.copy()
    spoiled[wrong, 2:] = np.random.default_rng(5).uniform((0, 0), (620, 480), (60, 2))
    found = estimate(spoiled)
    assert distance(found.F) < 2.0 * distance(estimate(pixels[~wrong]).F) + 0.05
    assert found.inliers[wrong].mean() < 0.1
    assert found.inliers[~wrong].mean() > 0.97


@pytest.mark.long
def test_the_covariance_is_right():
    true, squared = unit(pair().fundamental).ravel(), []
    for seed in range(150):
        pixels = matches(150, 7) + np.random.default_rng((seed, 2)).normal(0.0, SIGMA, (150, 4))
        found = estimate(pixels)
        error = unit(found.F).ravel() - true
        values, vectors = np.linalg.eigh(found.covariance)
        assert (values[:2] < 1e-6 * values[2]).all()  # rank 7
        squared.append(((vectors[:, 2:].T @ error) ** 2 / values[2:]).sum() / 7.0)
    assert np.mean(squared) == pytest.approx(1.0, abs=0.2)


def test_too_few_or_degenerate_matches():
    pixels = matches(8, 0)
    with pytest.raises(ValueError, match="8 matches"):
        fundamental_by_eight(pixels[:7, :2], pixels[:7, 2:])
    assert estimate_fundamental(pixels[:, :2], pixels[:, 2:], np.zeros(8), np.tile(np.eye(2), (8, 1, 1))) is None


@pytest.mark.long
def test_epipoles_are_as_far_off_as_their_covariances_say():
    """Of either image, over twenty draws of the noise; two degrees of freedom."""
    exact, true = matches(150, 0), epipoles(pair().fundamental)
    squared = []
    for seed in range(20):
        found = estimate(exact + np.random.default_rng(seed).normal(0.0, SIGMA, exact.shape))
        for (epipole, covariance), other in zip(uncertain_epipoles(found), true, strict=True):
            values, vectors = np.linalg.eigh(covariance)
            assert values[0] < 1e-6 * values[1]  # the length is no error
            error = vectors[:, 1:].T @ (other * np.sign(other @ epipole) - epipole)
            squared.append(float((error**2 / values[1:]).mean()))
    assert 0.5 < np.mean(squared) < 1.5


def test_an_epipole_is_a_place_a_direction_or_unknown():
    spread = np.diag([1e-6, 1e-6, 1e-12])
    near = np.array([100.0, 50.0, 1.0]) / np.linalg.norm([100.0, 50.0, 1.0])
    assert "at (100, 50) px" in describe_epipole(near, spread, (640, 480))
    far = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0])
    assert "far away along 30.0 deg" in describe_epipole(far, spread, (640, 480))
    assert "unknown" in describe_epipole(near, np.full((3, 3), np.inf), (640, 480))

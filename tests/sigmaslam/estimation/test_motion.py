import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse, se3_log

STILL = np.zeros(6)
DENSITIES = np.array([0.3, 0.2])


def covariance_of(size: int, sigma: float, seed: int = 0) -> np.ndarray:
    root = sigma * np.random.default_rng(seed).standard_normal((size, size))
    return np.asarray(root @ root.T + 0.01 * sigma**2 * np.eye(size))


def joint_covariance(motion: MotionFilter) -> np.ndarray:
    return motion._covariance


def moving(backend: str = "onnx") -> MotionFilter:
    """A filter that has seen some frames: pose and twist are correlated."""
    motion = MotionFilter(backend)
    motion.set_twist(np.array([0.2, -0.1, 1.0, 0.05, 0.1, -0.02]), np.repeat([0.3, 0.1], 3))
    for _ in range(3):
        motion.predict(0.1, DENSITIES)
    return motion


def test_a_known_circle_is_driven_to_its_end():
    """1 m/s forward and a quarter turn a second to the right; after one second a quarter round, after four back."""
    motion = MotionFilter()
    motion.set_twist(np.array([0, 0, 1, 0, np.pi / 2, 0]), STILL)
    motion.predict(1.0, np.zeros(2))
    radius = 2 / np.pi
    quarter = [[0, 0, 1, radius], [0, 1, 0, 0], [-1, 0, 0, radius], [0, 0, 0, 1]]
    np.testing.assert_allclose(motion.step, quarter, atol=1e-15)
    for _ in range(3):
        motion.predict(1.0, np.zeros(2))
    np.testing.assert_allclose(motion.step, np.eye(4), atol=1e-14)
    assert (motion.step_covariance == 0).all()


def test_uncertainty_at_rest_grows_by_the_integral_of_white_acceleration():
    motion = MotionFilter()
    motion.forget_twist(np.repeat([1e-4, 2e-4], 3))
    motion.predict(2.0, np.array([3e-9, 6e-9]))
    expected = np.repeat([4e-8 + 3e-9 * 8 / 3, 16e-8 + 6e-9 * 8 / 3], 3)
    np.testing.assert_allclose(motion.step_covariance, np.diag(expected), rtol=1e-4, atol=1e-14)


def test_onnx_and_torch_predict_the_same():
    pytest.importorskip("torch")
    one, other = moving("onnx"), moving("torch")
    np.testing.assert_allclose(one.step, other.step, atol=1e-14)
    np.testing.assert_allclose(joint_covariance(one), joint_covariance(other), atol=1e-14)


def test_widening_leaves_the_motion_and_what_is_correlated_with_what():
    """So that an image that fixes the pose says the same of the velocity, and leaves it that much less certain."""
    motion, wide = moving(), moving()
    before, seen = joint_covariance(motion).copy(), se3_exp(1e-3 * np.ones(6)) @ motion.step
    wide.widen(9.0)
    np.testing.assert_allclose(joint_covariance(wide), 9.0 * before)
    np.testing.assert_array_equal(wide.step, motion.step)
    np.testing.assert_array_equal(wide.twist, motion.twist)
    for each in (motion, wide):
        each.correct(seen, np.zeros((6, 6)))
    np.testing.assert_allclose(wide.twist, motion.twist, atol=1e-9)
    left = [joint_covariance(each)[6:, 6:] for each in (wide, motion)]
    np.testing.assert_allclose(left[0], 9.0 * left[1], atol=1e-12)


def test_correct_equals_the_kalman_update_of_pose_and_twist_together():
    motion = moving()
    predicted, twist, P = motion.step, motion.twist, joint_covariance(motion).copy()
    noise, innovation = covariance_of(6, 0.03), 0.02 * np.random.default_rng(1).standard_normal(6)
    H = np.eye(6, 12)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + noise)
    change, posterior = gain @ innovation, P - gain @ H @ P

    step = se3_exp(change[:6]) @ predicted
    motion.correct(step, posterior[:6, :6])
    np.testing.assert_allclose(motion.step, step, atol=1e-14)
    np.testing.assert_allclose(motion.twist, twist + change[6:], atol=1e-12)
    np.testing.assert_allclose(joint_covariance(motion), posterior, atol=1e-12)


def test_a_pose_that_says_nothing_new_changes_nothing():
    motion = moving()
    step, twist, covariance = motion.step.copy(), motion.twist.copy(), joint_covariance(motion).copy()
    motion.correct(step, motion.step_covariance)
    np.testing.assert_allclose(motion.step, step, atol=1e-14)
    np.testing.assert_allclose(motion.twist, twist, atol=1e-12)
    np.testing.assert_allclose(joint_covariance(motion), covariance, atol=1e-12)


def test_a_perfect_pose_after_a_perfect_start_tells_the_mean_velocity():
    """Without noise the twist is known from two poses."""
    motion = MotionFilter()
    motion.forget_twist(np.full(6, 0.01))
    motion.predict(0.5, np.zeros(2))
    twist = np.array([0.01, -0.02, 0.01, 0.005, 0.01, -0.01])
    motion.correct(se3_exp(0.5 * twist), np.zeros((6, 6)))
    np.testing.assert_allclose(motion.twist, twist, atol=1e-6)
    assert np.abs(joint_covariance(motion)).max() < 1e-8


def test_a_pose_that_was_known_for_certain_teaches_nothing():
    motion = MotionFilter()
    motion.set_twist(np.array([0, 0, 1.0, 0, 0, 0]), np.full(6, 0.1))
    motion.correct(np.eye(4), np.zeros((6, 6)))
    assert motion.twist.tolist() == [0, 0, 1.0, 0, 0, 0]
    np.testing.assert_allclose(joint_covariance(motion)[6:, 6:], 0.01 * np.eye(6), atol=1e-16)


def test_a_keyframe_keeps_the_velocity_and_starts_from_where_it_is():
    motion = moving()
    twist, spread = motion.twist.copy(), joint_covariance(motion)[6:, 6:].copy()
    motion.start_keyframe()
    np.testing.assert_array_equal(motion.step, np.eye(4))
    assert (motion.step_covariance == 0).all()
    np.testing.assert_array_equal(motion.twist, twist)
    np.testing.assert_array_equal(joint_covariance(motion)[6:, 6:], spread)


def test_a_forgotten_twist_is_independent_of_the_pose():
    motion = moving()
    pose = motion.step_covariance.copy()
    motion.forget_twist(np.full(6, 0.5))
    assert (motion.twist == 0).all()
    assert (joint_covariance(motion)[:6, 6:] == 0).all()
    np.testing.assert_array_equal(motion.step_covariance, pose)
    np.testing.assert_array_equal(joint_covariance(motion)[6:, 6:], 0.25 * np.eye(6))


def test_velocity_is_found_from_noisy_poses_and_its_error_is_as_large_as_it_says():
    """A camera on a screw for 10 frames, 40 times: NEES of pose and twist."""
    rng = np.random.default_rng(3)
    values = []
    motion = MotionFilter()
    for _ in range(40):
        motion.start_keyframe()
        sigma = np.repeat([0.3, 0.1], 3)
        motion.forget_twist(sigma)
        twist, truth = sigma * rng.standard_normal(6), np.eye(4)
        density = np.repeat([1e-4, 1e-4], 3)
        for _ in range(10):
            # The exact joint increment of velocity and place under white acceleration.
            chol = np.linalg.cholesky([[0.05**3 / 3, 0.05**2 / 2], [0.05**2 / 2, 0.05]])
            place, change = (chol @ rng.standard_normal((2, 6))) * np.sqrt(density)
            truth = truth @ se3_exp(0.05 * twist + place)
            twist = twist + change
            motion.predict(0.05, density[[0, 3]])
            noise = np.diag(np.repeat([0.01, 0.004], 3) ** 2)
            seen = se3_exp(np.sqrt(np.diag(noise)) * rng.standard_normal(6)) @ truth
            P = motion.step_covariance
            gain = P @ np.linalg.inv(P + noise)
            change = gain @ se3_log(seen @ se3_inverse(motion.step))
            motion.correct(se3_exp(change) @ motion.step, P - gain @ P)
        error = np.r_[se3_log(truth @ se3_inverse(motion.step)), twist - motion.twist]
        values.append(error @ np.linalg.solve(joint_covariance(motion), error))
    # 99.9 % of means of 40 chi-square numbers with 12 degrees of freedom.
    assert 9.6 < np.mean(values) < 14.7


def test_long_sequences_stay_rigid_and_symmetric():
    """Predicted alone for 300 frames, and corrected in each by products with inverses by transposition."""
    free, corrected = moving(), moving()
    rng = np.random.default_rng(0)
    for _ in range(300):
        free.predict(0.02, DENSITIES)
        corrected.predict(0.02, DENSITIES)
        change = se3_exp(1e-3 * rng.standard_normal(6)) @ corrected.step
        corrected.correct(corrected.step @ se3_inverse(corrected.step) @ change, 0.5 * corrected.step_covariance)
        if rng.random() < 0.1:
            corrected.start_keyframe()
    for motion in (free, corrected):
        R = motion.step[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_array_equal(motion.step[3], [0, 0, 0, 1])
        P = joint_covariance(motion)
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > -1e-12 * np.abs(P).max()


def test_prediction_from_another_keyframe_is_the_same_motion():
    """The reference has no part in it: poses and covariances seen from elsewhere are carried by the adjoint."""
    one, other = moving(), moving()
    W = se3_exp([3.0, -2.0, 5.0, 1.0, -0.5, 0.7])
    A = np.eye(12)
    A[:6, :6] = se3_adjoint(W)
    scale = 1e-6
    one._covariance, other._covariance = scale * joint_covariance(one), scale * A @ joint_covariance(one) @ A.T
    other.step = W @ one.step
    one.predict(0.1, scale * DENSITIES)
    other.predict(0.1, scale * DENSITIES)
    np.testing.assert_allclose(other.step, W @ one.step, atol=1e-7)
    expected = A @ joint_covariance(one) @ A.T
    np.testing.assert_allclose(joint_covariance(other), expected, atol=1e-4 * np.abs(expected).max())

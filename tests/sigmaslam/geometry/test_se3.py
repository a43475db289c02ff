import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from sigmaslam.geometry import se3 as rotation


@pytest.fixture
def vectors() -> np.ndarray:
    """Rotation vectors: random ones, tiny ones, and ones within rounding of 180 degrees."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.concatenate(
        [
            generator.uniform(0, np.pi, 150),
            10.0 ** generator.uniform(-14, -1, 100),
            np.pi - 10.0 ** generator.uniform(-14, -1, 149),
            [0.0],
        ]
    )
    return angles[:, None] * directions


def test_exp_equals_scipy(vectors):
    np.testing.assert_allclose(
        rotation.rotation_exp(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=4e-16 * 10
    )


def test_log_inverts_exp_at_every_angle(vectors):
    np.testing.assert_allclose(rotation.rotation_log(rotation.rotation_exp(vectors)), vectors, atol=1e-14)


def test_log_keeps_relative_accuracy_of_tiny_rotations():
    np.testing.assert_allclose(
        rotation.rotation_log(rotation.rotation_exp([1e-9, -2e-9, 3e-9])), [1e-9, -2e-9, 3e-9], rtol=1e-12
    )


@pytest.mark.parametrize("axis", np.eye(3))
def test_log_of_half_turn_is_pi(axis):
    half_turn = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(np.abs(rotation.rotation_log(half_turn)), np.pi * axis, atol=1e-15)


def test_quaternions_equal_scipy(vectors):
    reference = Rotation.from_rotvec(vectors)
    quaternions = rotation.matrix_to_quaternion(reference.as_matrix())
    np.testing.assert_allclose(quaternions, reference.as_quat(canonical=True), atol=1e-14)
    np.testing.assert_allclose(rotation.quaternion_to_matrix(-3 * quaternions), reference.as_matrix(), atol=1e-14)


def test_quaternion_zero_is_refused():
    with pytest.raises(ValueError, match="zero"):
        rotation.quaternion_to_matrix(np.zeros((2, 4)))


def test_batches_equal_single_calls(vectors):
    batch = vectors[:12].reshape(3, 4, 3)
    matrices = rotation.rotation_exp(batch)
    assert matrices.shape == (3, 4, 3, 3)
    np.testing.assert_array_equal(matrices[1, 2], rotation.rotation_exp(batch[1, 2]))
    np.testing.assert_array_equal(rotation.rotation_log(matrices)[2, 1], rotation.rotation_log(matrices[2, 1]))


def test_nearest_rotation_removes_noise_and_reflections():
    generator = np.random.default_rng(1)
    true = rotation.rotation_exp(generator.normal(size=(5, 3)))
    noisy = true + 1e-4 * generator.normal(size=true.shape)
    nearest = rotation.nearest_rotation(noisy)
    np.testing.assert_allclose(nearest @ np.swapaxes(nearest, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(nearest, true, atol=1e-3)
    assert np.linalg.det(rotation.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


def _tangents() -> np.ndarray:
    generator = np.random.default_rng(2)
    tangents = generator.normal(size=(60, 6))
    tangents[:, 3:] *= (10.0 ** generator.uniform(-9, 0.2, 60))[:, None] / np.linalg.norm(tangents[:, 3:], axis=1)[
        :, None
    ]
    return tangents


def _wedge(tangent: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = rotation.skew(tangent[3:])
    matrix[:3, 3] = tangent[:3]
    return matrix


def test_se3_exp_and_log_equal_matrix_functions():
    tangents = _tangents()
    T = rotation.se3_exp(tangents)
    np.testing.assert_allclose(T, [expm(_wedge(tangent)) for tangent in tangents], atol=1e-13)
    np.testing.assert_allclose(rotation.se3_log(T), tangents, atol=1e-13)
    np.testing.assert_allclose(logm(T[3]), _wedge(rotation.se3_log(T[3])), atol=1e-10)


def test_se3_inverse_undoes():
    T = rotation.se3_exp(_tangents())
    np.testing.assert_allclose(rotation.se3_inverse(T) @ T, np.tile(np.eye(4), (60, 1, 1)), atol=1e-14)


def test_transformed_points_are_those_of_homogeneous_coordinates():
    generator = np.random.default_rng(6)
    T, points = rotation.se3_exp(generator.normal(size=6)), generator.normal(size=(5, 4, 3))
    homogeneous = np.concatenate([points, np.ones((5, 4, 1))], axis=-1)
    np.testing.assert_allclose(rotation.transform_points(T, points), (homogeneous @ T.T)[..., :3], atol=1e-14)


def test_adjoint_moves_a_tangent_through_a_transform():
    tangents = _tangents()
    T, small = rotation.se3_exp(tangents), 0.1 * np.roll(tangents, 7, axis=0)
    moved = (rotation.se3_adjoint(T) @ small[..., None])[..., 0]
    np.testing.assert_allclose(T @ rotation.se3_exp(small), rotation.se3_exp(moved) @ T, atol=1e-13)


def test_a_turned_covariance_is_that_of_moved_tangents():
    T = rotation.se3_exp(_tangents()[:20])
    root = np.random.default_rng(1).normal(size=(20, 6, 6))
    moved = rotation.se3_adjoint(T) @ root
    turned = rotation.turn_covariance(T, root @ root.transpose(0, 2, 1))
    np.testing.assert_allclose(turned, moved @ moved.transpose(0, 2, 1), rtol=0, atol=1e-9 * np.abs(turned).max())
    one_by_one = [rotation.turn_covariance(each, root[0] @ root[0].T) for each in T]
    np.testing.assert_allclose(rotation.turn_covariance(T, root[0] @ root[0].T), one_by_one, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.09, 0.11, 1.0, 1.5, 1.6, 3.0, np.pi])
def test_one_transform_equals_its_row_of_many(angle: float):
    """Single ones are computed in another way, up to a right angle their logarithms too."""
    tangents = np.random.default_rng(0).normal(size=(20, 6))
    tangents[:, 3:] *= angle / np.linalg.norm(tangents[:, 3:], axis=1, keepdims=True)
    transforms = rotation.se3_exp(tangents)
    np.testing.assert_allclose([rotation.se3_exp(each) for each in tangents], transforms, rtol=0, atol=5e-15)
    np.testing.assert_allclose(
        [rotation.se3_log(each) for each in transforms], rotation.se3_log(transforms), rtol=0, atol=5e-15
    )

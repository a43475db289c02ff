"""Rotations and rigid transforms as small vectorised functions on numpy arrays.

Quaternions are (x, y, z, w), Hamilton convention. The tangent of SE(3) is (translation, rotation), as in
Barfoot, "State Estimation for Robotics", chapter 8.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np


def skew(vectors: np.ndarray) -> np.ndarray:
    """Cross-product matrices: `skew(a) @ b == cross(a, b)`; (..., 3) -> (..., 3, 3)."""
    v = np.asarray(vectors)
    if v.ndim == 1:  # a third of the time
        x, y, z = v.tolist()
        return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], v.dtype)
    matrix = np.zeros((*v.shape[:-1], 3, 3), dtype=v.dtype)
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def quaternion_to_matrix(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions, which are normalised first.

    Args:
        quaternions: (..., 4) as (x, y, z, w), any length but zero.
    Returns:
        (..., 3, 3) rotation matrices.
    Raises:
        ValueError: a quaternion is zero or not finite.
    """
    q = np.asarray(quaternions, dtype=np.float64)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.isfinite(length) & (length > 0)):
        raise ValueError("a quaternion is zero or not finite, so it has no rotation")
    q = q / length
    v, w = q[..., :3], q[..., 3, None, None]
    outer = v[..., :, None] * v[..., None, :]
    square = np.sum(v * v, axis=-1)[..., None, None]
    return np.asarray((1.0 - 2.0 * square) * np.eye(3) + 2.0 * outer + 2.0 * w * skew(v))


def matrix_to_quaternion(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (x, y, z, w) with w >= 0; accurate at every angle, 180 degrees included.

    The rows of 4 q q^T follow from the matrix without division (Shepperd, 1978); the one with the largest
    diagonal entry is normalised.

    Args:
        rotations: (..., 3, 3) rotation matrices.
    Returns:
        (..., 4) unit quaternions.
    """
    m = np.asarray(rotations, dtype=np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    rows = [
        np.stack([1 + xx - yy - zz, xy, xz, xw], axis=-1),
        np.stack([xy, 1 - xx + yy - zz, yz, yw], axis=-1),
        np.stack([xz, yz, 1 - xx - yy + zz, zw], axis=-1),
        np.stack([xw, yw, zw, 1 + xx + yy + zz], axis=-1),
    ]
    outer = np.stack(rows, axis=-2)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def rotation_log(rotations: np.ndarray) -> np.ndarray:
    """Rotation vectors of rotation matrices; (..., 3, 3) -> (..., 3) radians, length in [0, pi]."""
    q = matrix_to_quaternion(rotations)
    v, w = q[..., :3], q[..., 3:]
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    # angle / sin(angle / 2) tends to 2 as the angle goes to zero (w is then 1).
    factor = np.where(sine > 0, 2.0 * np.arctan2(sine, w) / np.where(sine > 0, sine, 1.0), 2.0)
    return np.asarray(factor * v)


def rotation_exp(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices of rotation vectors; (..., 3) radians -> (..., 3, 3)."""
    phi = np.asarray(vectors, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    q = np.concatenate([0.5 * np.sinc(angle / (2 * np.pi)) * phi, np.cos(angle / 2)], axis=-1)
    return quaternion_to_matrix(q)


def nearest_rotation(matrices: np.ndarray) -> np.ndarray:
    """The rotation closest in the Frobenius norm to each matrix; (..., 3, 3) -> (..., 3, 3)."""
    u, _, vt = np.linalg.svd(np.asarray(matrices, dtype=np.float64))
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def rigid_motion(rotation: np.ndarray, translation: np.ndarray | Sequence[float]) -> np.ndarray:
    """Matrices (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    translation = np.asarray(translation)
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def se3_inverse(T: np.ndarray) -> np.ndarray:
    """Inverses of rigid transforms; (..., 4, 4) -> (..., 4, 4)."""
    T = np.asarray(T)
    inverse = np.zeros(T.shape, T.dtype)
    rotation = T[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ T[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) in the frame that T (4, 4) takes them to."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def is_rigid(T: Any) -> bool:
    """Whether it is a rotation, to the six digits that files have, with a translation; (4, 4)."""
    try:
        T = np.asarray(T, dtype=float)
    except (TypeError, ValueError):
        return False
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], np.eye(4)[3], rtol=0.0, atol=1e-9):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0.0)


def nearest_rigid(T: np.ndarray) -> np.ndarray:
    """Rigid transforms with orthonormal rotations next to those of T; (..., 4, 4) -> (..., 4, 4).

    An inverse by transposition doubles the error of a rotation. Without this, products of poses and inverses over
    successive frames leave the group within a hundred frames.
    """
    rigid = np.array(T, dtype=np.float64)
    rigid[..., :3, :3] = nearest_rotation(rigid[..., :3, :3])
    return rigid


def se3_adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoints of rigid transforms: `T exp(x) T^-1 == exp(adjoint @ x)`, x = (translation, rotation).

    Args:
        T: (..., 4, 4) rigid transforms.
    Returns:
        (..., 6, 6) adjoint matrices, eq. (8.50).
    """
    T = np.asarray(T)
    adjoint = np.zeros((*T.shape[:-2], 6, 6), dtype=T.dtype)
    rotation = T[..., :3, :3]
    adjoint[..., :3, :3] = rotation
    adjoint[..., 3:, 3:] = rotation
    adjoint[..., :3, 3:] = skew(T[..., :3, 3]) @ rotation
    return adjoint


def turn_covariance(T: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariances of tangent vectors in another frame: of `se3_adjoint(T) @ x`.

    Args:
        T: (..., 4, 4) rigid transforms.
        covariance: (..., 6, 6) of x = (translation, rotation).
    Returns:
        (..., 6, 6) covariances.
    """
    adjoint = se3_adjoint(T)
    return np.asarray(adjoint @ covariance @ np.swapaxes(adjoint, -1, -2))


def se3_body(T: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of a pose in the body frame, from that of its perturbation from the left."""
    spread = turn_covariance(se3_inverse(T), covariance)
    return np.asarray(0.5 * (spread + spread.T))


def se3_exp(tangent: np.ndarray) -> np.ndarray:
    """Rigid transforms of tangent vectors (translation, rotation); (..., 6) -> (..., 4, 4)."""
    xi = np.asarray(tangent, dtype=np.float64)
    if xi.ndim == 1:
        return _exp_of_one(xi[:3], xi[3:])
    phi = xi[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    square = angle * angle
    series = 1 / 6 - square / 120 + square**2 / 5040 - square**3 / 362880
    safe = np.where(angle > 0.1, angle, 1.0)
    second = np.where(angle > 0.1, (safe - np.sin(safe)) / safe**3, series)
    cross = skew(phi)
    left_jacobian = np.eye(3) + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross + second * (cross @ cross)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = rotation_exp(phi)
    T[..., :3, 3] = (left_jacobian @ xi[..., :3, None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def se3_log(T: np.ndarray) -> np.ndarray:
    """Tangent vectors (translation, rotation) of rigid transforms; (..., 4, 4) -> (..., 6)."""
    T = np.asarray(T, dtype=np.float64)
    if T.ndim == 2 and np.trace(T) > 2.0:
        return _log_of_one(T[:3, :3], T[:3, 3])
    phi = rotation_log(T[..., :3, :3])
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    square = angle * angle
    series = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    safe = np.where(angle > 0.1, angle, 1.0)
    second = np.where(angle > 0.1, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2, series)
    cross = skew(phi)
    inverse_jacobian = np.eye(3) - 0.5 * cross + second * (cross @ cross)
    return np.concatenate([(inverse_jacobian @ T[..., :3, 3:])[..., 0], phi], axis=-1)


def _exp_of_one(rho: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """`se3_exp` of one vector, whose parts are (3,): a fifth of the time."""
    square = float(phi @ phi)
    angle = math.sqrt(square)
    cross = skew(phi)
    across = cross @ cross
    sine, half = (math.sin(angle) / angle, math.sin(0.5 * angle) / (0.5 * angle)) if angle > 0.0 else (1.0, 1.0)
    series = 1 / 6 - square / 120 + square**2 / 5040 - square**3 / 362880
    second = (1.0 - sine) / square if angle > 0.1 else series
    T = np.eye(4)
    T[:3, :3] += sine * cross + 0.5 * half * half * across
    T[:3, 3] = rho + 0.5 * half * half * (cross @ rho) + second * (across @ rho)
    return T


def _log_of_one(R: np.ndarray, position: np.ndarray) -> np.ndarray:
    """`se3_log` of one transform (3, 3), (3,) that turns by less than a right angle."""
    phi = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = math.sqrt(float(phi @ phi))
    angle = math.atan2(sine, 0.5 * (float(np.trace(R)) - 1.0))
    phi *= angle / sine if sine > 0.0 else 1.0
    square = angle * angle
    series = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    second = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square if angle > 0.1 else series
    cross = skew(phi)
    return np.concatenate([position - 0.5 * (cross @ position) + second * (cross @ (cross @ position)), phi])

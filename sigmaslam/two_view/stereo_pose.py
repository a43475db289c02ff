"""Relative pose without a prediction (9.5.1): 5-point method with scale from stereo, checked against P3P."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from sigmaslam.estimation.calibration_errors import measured_errors
from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN
from sigmaslam.estimation.clustered_errors import clustering
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend.patch_kernels import compiled
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rigid_motion, se3_exp, se3_inverse, skew
from sigmaslam.two_view.epipolar import estimate_epipolar_pose

# P3P runs once with each inlier threshold, pixels. The second separates slow movers from the static scene.
_THRESHOLDS = (2.0, 0.5)
# Where so many agree with the first one no other pose explains more, unless their variances are that much smaller than
# claimed: what moves slowly may hide in the claims.
_CLEAR, _AS_CLAIMED = 0.8, 0.25
# The true variances may be smaller than the claimed ones by this factor.
_MIN_SCALE = 1.0 / 16.0
MIN_POINTS = 8
"""Fewer agree with a pose by chance: three fix it."""
MIN_DISPARITY = 1.0
"""A smaller disparity gives no scale, pixels."""
# Gauss-Newton takes so many steps. The scale of its robust loss, standard deviations, shrinks by a factor each step.
_STEPS, _FIRST_SCALE, _NARROWING, _LAST_SCALE = 10, 8.0, 0.75, 2.0
# Beyond this condition number float64 inverts noise: the points leave something free.
_MAX_CONDITION = 1e14


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Pose between two views of a scene.

    Attributes:
        T_key_camera: (4, 4).
        inliers: (M,) bool, points that agree with the pose.
        covariance: (6, 6) of x in T_key_camera exp(x), x = (translation, rotation), from the inliers' noise.
        scale: 1 or less, ratio of the actual to the claimed variances of most points.
        clustering: factor by which `covariance` is too small for errors that neighbours share; not applied to it.
        foreseen: number of landmarks that the pose sees, if they were searched for.
        by_calibration: (6, 15) by how much each error of the calibration, of size one, moves x; not in `covariance`.
    """

    T_key_camera: np.ndarray
    inliers: np.ndarray
    covariance: np.ndarray
    scale: float
    clustering: float = 1.0
    foreseen: int = 0
    by_calibration: np.ndarray = field(default_factory=lambda: np.zeros((6, CALIBRATION_SIZE)))

    def with_shared_errors(self, calibration: np.ndarray) -> "RelativePose":
        """The same whose covariance has what neighbours share, and the calibration's errors of covariance (15, 15)."""
        shared = self.by_calibration @ calibration @ self.by_calibration.T
        return replace(self, covariance=max(self.clustering, 1.0) * self.covariance + shared)


def estimate_relative_pose(
    camera: RectifiedStereo,
    landmarks: np.ndarray,
    landmark_sigma: np.ndarray,
    measurement: np.ndarray,
    noise: np.ndarray,
    probability: np.ndarray,
) -> RelativePose | None:
    """Pose of the current view in the keyframe, from stereo points and their current measurements.

    The essential matrix uses far points and ignores errors of depth, but fails without parallax. P3P on stereo points
    is the opposite, and stands alone where most agree with it. Candidates are refined, and the one with the smallest
    misfit is returned: the sum of squared errors in sigmas, each limited to the gate. The number of inliers is a worse
    criterion: a rotation in place of a translation may agree a little with a moving object and with the scene alike.
    The claimed sigmas are scaled to the errors of half of the points, as matches may be better than claimed.

    Args:
        landmarks: (M, 3) (u, v, disparity) in the keyframe.
        landmark_sigma: (M, 3) their standard deviations, pixels.
        measurement: (M, 3) (u, v, disparity) in the current view; the disparity may be NaN.
        noise: (M, 3, 3) covariance of the measurement, pixels squared.
        probability: (M,) that a match is right.
    Returns:
        The pose; None when fewer than eight points agree with either candidate.
    """
    near = landmarks[:, 2] >= MIN_DISPARITY
    if near.sum() < MIN_POINTS:
        return None
    points = camera.triangulate(np.where(near[:, None], landmarks, [0.0, 0.0, 1.0]))
    matches = _StereoMatches(camera, landmarks, landmark_sigma, measurement, noise, near * probability)
    near_points, near_pixels = points[near], np.ascontiguousarray(measurement[near, :2])
    first, share = _from_points(camera, near_points, near_pixels, _THRESHOLDS[0])
    if first is not None and share >= _CLEAR:
        pose = _best(matches, [first])
        agree = 0.0 if pose is None or pose.scale < _AS_CLAIMED else matches.weight @ pose.inliers
        if agree >= _CLEAR * matches.weight.sum():
            return pose
    second, _ = _from_points(camera, near_points, near_pixels, _THRESHOLDS[1])
    given = points, near, landmarks[:, :2], measurement[:, :2], probability, noise[:, :2, :2]
    return _best(matches, [_from_essential(camera, *given), first, second])


def foresee(
    camera: RectifiedStereo, landmarks: np.ndarray, landmark_sigma: np.ndarray, relative: RelativePose
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a pose sees landmarks of the keyframe; the first arguments as of `estimate_relative_pose`.

    Returns:
        (M, 3) (u, v, disparity) there, their covariances (M, 3, 3), and whether (M,) each is inside the image.
    """
    predicted, front, by_pose, by_landmark = _project(camera, landmarks, se3_inverse(relative.T_key_camera))
    covariance = by_pose @ relative.covariance @ by_pose.transpose(0, 2, 1) + _propagated(by_landmark, landmark_sigma)
    u, v = predicted[:, 0], predicted[:, 1]
    return predicted, covariance, front & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)


def _best(matches: "_StereoMatches", candidates: list[np.ndarray | None]) -> RelativePose | None:
    """Of poses T_camera_key (4, 4) the one with the smallest misfit once refined."""
    guesses = [guess for guess in candidates if guess is not None and np.isfinite(guess).all()]
    if not guesses:
        return None
    # Squared errors do not depend on the loss.
    scale = min(_variance_scale(matches.weight, matches.equations(guess, 1.0)[0]) for guess in guesses)
    refined = [T for guess in guesses if (T := _refine_pose(matches, guess, scale)) is not None]
    if not refined:
        return None
    errors = [matches.equations(T, 1.0)[0] for T in refined]
    scale = min(_variance_scale(matches.weight, squared) for squared in errors)
    # The misfit weights the squared errors, each limited to the gate.
    misfit = [float(matches.weight @ np.minimum(squared / scale, CHI_SQUARE_999[3])) for squared in errors]
    best = int(np.argmin(misfit))
    return _pose_with_inliers(matches, refined[best], errors[best], scale)


def _from_essential(
    camera: RectifiedStereo,
    points: np.ndarray,
    near: np.ndarray,
    pixels_key: np.ndarray,
    pixels: np.ndarray,
    probability: np.ndarray,
    covariance: np.ndarray,
) -> np.ndarray | None:
    """T_camera_key from the essential matrix; the length of the translation comes from stereo depth."""
    pose = estimate_epipolar_pose(camera.matrix, pixels_key, pixels, probability, covariance)
    if pose is None:
        return None
    R, direction = pose.R, pose.direction
    used = near & pose.inliers
    if used.sum() < MIN_POINTS:
        return None
    # x ~ R X + s t: the cross product with the ray leaves one unknown per point, s. Its median is robust.
    rays = np.linalg.solve(camera.matrix, np.c_[pixels[used], np.ones(used.sum())].T).T
    constant = np.cross(rays, points[used] @ R.T)
    slope = np.cross(rays, direction)
    strength = np.einsum("ij,ij->i", slope, slope)
    scales = -np.einsum("ij,ij->i", slope, constant) / np.maximum(strength, 1e-12)
    return rigid_motion(R, max(float(np.median(scales)), 0.0) * direction)


def _from_points(
    camera: RectifiedStereo, points: np.ndarray, pixels: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, float]:
    """T_camera_key from P3P in RANSAC, and the share of the points that agree."""
    succeeded, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        None,
        flags=cv2.SOLVEPNP_AP3P,
        iterationsCount=500,
        reprojectionError=threshold,
        confidence=0.9999,
    )
    if not succeeded:
        return None, 0.0
    return rigid_motion(cv2.Rodrigues(rotation)[0], translation.ravel()), len(inliers) / len(points)


@dataclass(frozen=True, slots=True)
class _StereoMatches:
    """Stereo points and their current measurements, as in `estimate_relative_pose`; far points have weight 0."""

    camera: RectifiedStereo
    landmarks: np.ndarray
    landmark_sigma: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray
    weight: np.ndarray

    def linearise(self, T_camera_key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Residual (M, 3), derivatives of what is expected, by a perturbation of T from the left (M, 3, 6) and by the
        landmark (M, 3, 3), and information (M, 3, 3).

        Unknown components, and points behind the camera, have zero information.
        """
        predicted, front, by_pose, by_landmark = _project(self.camera, self.landmarks, T_camera_key)
        spread = self.noise + _propagated(by_landmark, self.landmark_sigma)
        residual = self.measurement - predicted
        measured = np.isfinite(residual) & front[:, None]
        present = measured[:, :, None] & measured[:, None, :]
        information = np.where(present, np.linalg.inv(np.where(present, spread, np.eye(3))), 0.0)
        return np.where(measured, residual, 0.0), by_pose, by_landmark, information

    def equations(self, T_camera_key: np.ndarray, loss: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squared errors (M,) in sigmas, infinite for points behind the camera, and the equations of Gauss-Newton.

        Args:
            T_camera_key: (4, 4) where they are linearised.
            loss: square of the robust loss' scale.
        Returns:
            The errors, the normal matrix (6, 6) and the gradient (6,).
        """
        kernels = compiled()
        if kernels is not None:
            camera = self.camera
            intrinsics = camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline
            given = self.landmarks, self.landmark_sigma, self.measurement, self.noise, self.weight
            squared, sums = kernels.stereo_equations(intrinsics, *given, T_camera_key, loss)
            return squared, sums[:36].reshape(6, 6), sums[36:]
        residual, by_pose, _, information = self.linearise(T_camera_key)
        squared = np.einsum("mi,mij,mj->m", residual, information, residual)
        weight = self.weight / (1.0 + squared / loss) ** 2
        weighted = by_pose.transpose(0, 2, 1) @ (information * weight[:, None, None])
        squared = np.where(np.trace(information, axis1=1, axis2=2) > 0, squared, np.inf)
        return squared, (weighted @ by_pose).sum(axis=0), np.einsum("mij,mj->i", weighted, residual)


def _project(
    camera: RectifiedStereo, landmarks: np.ndarray, T_camera_key: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where landmarks (M, 3) of a keyframe are seen, (M, 3), and whether in front of the camera (M,).

    And the derivatives by a perturbation of T from the left (M, 3, 6) and by the landmark (M, 3, 3).
    """
    focal = camera.focal_baseline
    # Points are scaled by inverse depth, so that points at infinity are regular.
    rays = camera.rays(landmarks[:, :2])
    inverse_depth = landmarks[:, 2] / focal
    R, t = T_camera_key[:3, :3], T_camera_key[:3, 3]
    seen = rays @ R.T + inverse_depth[:, None] * t
    front = seen[:, 2] > 1e-6
    x, y, z = np.where(front[:, None], seen, [0.0, 0.0, 1.0]).T
    predicted = np.column_stack(
        [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, focal * inverse_depth / z]
    )
    by_seen = np.zeros((len(z), 3, 3))
    by_seen[:, 0, 0], by_seen[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_seen[:, 1, 1], by_seen[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    by_seen[:, 2, 2] = -focal * inverse_depth / z**2
    by_pose = np.concatenate([by_seen * inverse_depth[:, None, None], -by_seen @ skew(seen)], axis=2)
    by_landmark = by_seen @ np.column_stack([R[:, 0] / camera.fx, R[:, 1] / camera.fy, t / focal])
    by_landmark[:, 2, 2] += 1.0 / z
    return predicted, front, by_pose, by_landmark


def _propagated(by: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Covariance (M, 3, 3) by derivatives (M, 3, 3) of what has standard deviations (M, 3)."""
    return (by * (sigma**2)[:, None, :]) @ by.transpose(0, 2, 1)


def _refine_pose(matches: _StereoMatches, T_camera_key: np.ndarray, variance: float) -> np.ndarray | None:
    """Gauss-Newton with a robust loss whose scale shrinks from step to step; None where points leave the pose open.

    Variances are `variance` times the claimed ones.
    """
    scale = _FIRST_SCALE
    for _ in range(_STEPS):
        _, normal, gradient = matches.equations(T_camera_key, variance * scale**2)
        if not np.linalg.cond(normal) < _MAX_CONDITION:
            return None
        T_camera_key = se3_exp(np.linalg.solve(normal, gradient)) @ T_camera_key
        scale = max(_NARROWING * scale, _LAST_SCALE)
    return T_camera_key


def _variance_scale(weight: np.ndarray, squared: np.ndarray) -> float:
    """Ratio of the actual to the claimed variances, from the weighted median of squared errors (M,); 1 at most."""
    order = np.argsort(squared)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(np.clip(squared[order[half]] / CHI_SQUARE_MEDIAN[3], _MIN_SCALE, 1.0))


def _pose_with_inliers(
    matches: _StereoMatches, T_camera_key: np.ndarray, squared: np.ndarray, scale: float
) -> RelativePose | None:
    """The pose with its inliers by the squared errors (M,), and its covariance from the claimed variances."""
    inliers = (matches.weight > 0) & (squared < scale * CHI_SQUARE_999[3])
    if inliers.sum() < MIN_POINTS:
        return None
    residual, by_pose, by_landmark, information = (each[inliers] for each in matches.linearise(T_camera_key))
    weighted = by_pose.transpose(0, 2, 1) @ information
    normal = (weighted @ by_pose).sum(axis=0)
    if not np.linalg.cond(normal) < _MAX_CONDITION:
        return None
    size = matches.camera.width, matches.camera.height
    shared = clustering(matches.landmarks[inliers, :2], size, (weighted @ residual[..., None])[..., 0], normal)
    # Of a place alone nothing is asked of its disparity.
    seen, known = (measured_errors(matches.camera, uvd[inliers]) for uvd in (matches.measurement, matches.landmarks))
    by_error = np.nan_to_num(seen - by_landmark @ known)
    covariance = np.linalg.inv(normal)
    # A perturbation of T_camera_key from the left is the opposite of one of its inverse from the right.
    by_calibration = -covariance @ (weighted @ by_error).sum(axis=0)
    return RelativePose(se3_inverse(T_camera_key), inliers, covariance, scale, shared, by_calibration=by_calibration)

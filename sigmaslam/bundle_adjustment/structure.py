"""Observations and landmarks at fixed poses: residuals, the best points, and the selection of inliers."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.bundle_adjustment.track_file import Tracks, without_disparity
from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.geometry.se3 import se3_inverse

# Whitened residuals beyond the 95 % quantile of chi with 3 degrees of freedom count linearly (Huber's loss).
HUBER = 2.795
_NEWTON_STEPS = 8
_NEWTON_PIXELS = 1e-3


@dataclass(frozen=True, slots=True)
class Observations:
    """Observations of landmarks by keyframes, both numbered from 0.

    Attributes:
        keyframe, landmark: (O,) int64.
        measurement: (O, 3) (u, v, disparity), pixels; a missing disparity is 0.
        whitening: (O, 3, 3) upper triangular W with W^T W the inverse of the covariance; zero for a missing disparity.
        stereo: (O,) bool, whether there is a disparity.
        host: (L,) the first observation of each landmark.
        intrinsics: (5,) fx, fy, cx, cy, baseline.
    """

    keyframe: np.ndarray
    landmark: np.ndarray
    measurement: np.ndarray
    whitening: np.ndarray
    stereo: np.ndarray
    host: np.ndarray
    intrinsics: np.ndarray

    def __len__(self) -> int:
        return len(self.keyframe)


@dataclass(frozen=True, slots=True)
class Structure:
    """Landmarks that fit their observations best, poses fixed.

    Attributes:
        points: (L, 3) in the world, metres; not finite for landmarks at infinity or behind their host.
        significance: (L,) inverse depth in units of its standard deviation.
    """

    points: np.ndarray
    significance: np.ndarray


def collect(tracks: Tracks) -> tuple[Observations, np.ndarray]:
    """The observations with keyframes and landmarks numbered from 0, and the frames (K,) of the keyframes."""
    frames, keyframe = np.unique(tracks.frame, return_inverse=True)
    _, host, landmark = np.unique(tracks.landmark, return_index=True, return_inverse=True)
    stereo = ~np.isnan(tracks.measurement[:, 2])
    information = np.linalg.inv(without_disparity(tracks.measurement, tracks.covariance))
    information[~stereo, 2, 2] = 0.0
    whitening = np.zeros_like(information)
    whitening[stereo] = _upper_root(information[stereo])
    whitening[~stereo, :2, :2] = _upper_root(information[~stereo, :2, :2])
    observations = Observations(
        keyframe, landmark, np.nan_to_num(tracks.measurement), whitening, stereo, host, tracks.intrinsics
    )
    return observations, frames


def whitened_residuals(
    observations: Observations, poses: np.ndarray, points: np.ndarray, offset: float
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (O, 3), predicted minus measured, and whether the point is in front of the camera, (O,) bool.

    Args:
        observations: O of them.
        poses: (K, 4, 4) T_world_camera of the rectified camera.
        points: (L, 3) in the world.
        offset: disparity offset, pixels.
    """
    seen, in_front = _in_camera(observations, poses, points)
    predicted, _ = _project(observations.intrinsics, seen, 1.0)
    predicted[:, 2] += offset
    return _apply(observations.whitening, predicted - observations.measurement), in_front


def point_covariances(
    observations: Observations, kept: np.ndarray, poses: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Covariances (L, 3, 3) of points in the world, given poses and offset; NaN for points without observations.

    Args:
        observations: O of them.
        kept: (O,) bool, the observations to use.
        poses, points: as for `whitened_residuals`.
    """
    seen, _ = _in_camera(observations, poses, points)
    _, jacobian = _project(observations.intrinsics, seen, 1.0)
    jacobian = observations.whitening @ jacobian @ poses[observations.keyframe, :3, :3].transpose(0, 2, 1)
    jacobian[~kept] = 0.0
    information = _sum_by_landmark(observations, jacobian.transpose(0, 2, 1) @ jacobian)
    regular = np.bincount(observations.landmark[kept], minlength=len(observations.host)) > 0
    covariances = np.full_like(information, np.nan)
    covariances[regular] = np.linalg.inv(information[regular])
    return covariances


def fit_structure(observations: Observations, kept: np.ndarray, poses: np.ndarray, offset: float) -> Structure:
    """Each landmark by Gauss-Newton with Huber's loss, as (u, v, disparity) in its host, where infinity is regular.

    Arguments are those of `point_covariances` and `whitened_residuals`.
    """
    fx, fy, _, _, baseline = observations.intrinsics
    focal_baseline = fx * baseline
    landmark, host = observations.landmark, observations.host
    T_world_host = poses[observations.keyframe[host]]
    T_camera_host = (se3_inverse(poses)[observations.keyframe] @ T_world_host[landmark])[:, :3]
    place = _first_guess(observations, offset)
    weight = kept.astype(np.float64)
    information = np.zeros((len(host), 3, 3))
    for _ in range(_NEWTON_STEPS):
        rays = _rays(observations.intrinsics, place)
        inverse_depth = place[:, 2] / focal_baseline
        # Points in the frame of each camera are scaled by their inverse depth in the host.
        seen = np.einsum("oij,oj->oi", T_camera_host[:, :, :3], rays[landmark])
        seen += T_camera_host[:, :, 3] * inverse_depth[landmark, None]
        in_front = seen[:, 2] > 0
        seen[~in_front] = [0, 0, 1]
        predicted, by_seen = _project(observations.intrinsics, seen, inverse_depth[landmark])
        predicted[:, 2] += offset
        by_place = np.stack(
            [T_camera_host[:, :, 0] / fx, T_camera_host[:, :, 1] / fy, T_camera_host[:, :, 3] / focal_baseline], axis=-1
        )
        jacobian = by_seen @ by_place
        # The disparity depends on the inverse depth directly, too.
        jacobian[:, 2, 2] += 1.0 / seen[:, 2]
        jacobian = observations.whitening @ jacobian
        residual = _apply(observations.whitening, observations.measurement - predicted)
        length = np.linalg.norm(residual, axis=1)
        weight = kept * in_front * np.where(length > HUBER, HUBER / np.maximum(length, HUBER), 1.0)
        weighted = weight[:, None, None] * jacobian
        information = _sum_by_landmark(observations, weighted.transpose(0, 2, 1) @ jacobian)
        gradient = _sum_by_landmark(observations, np.einsum("oji,oj->oi", weighted, residual))
        regular = _is_regular(information)
        step = np.zeros_like(place)
        step[regular] = np.linalg.solve(information[regular], gradient[regular][..., None])[..., 0]
        place = place + step
        if np.abs(step).max(initial=0.0) < _NEWTON_PIXELS:
            break
    regular = _is_regular(information)
    sigma = np.full(len(host), np.inf)
    sigma[regular] = np.sqrt(np.linalg.inv(information[regular])[:, 2, 2])
    depth = np.where(place[:, 2] > 0, focal_baseline / np.where(place[:, 2] > 0, place[:, 2], 1.0), np.nan)
    rays = _rays(observations.intrinsics, place)
    points = np.einsum("lij,lj->li", T_world_host[:, :3, :3], rays * depth[:, None]) + T_world_host[:, :3, 3]
    return Structure(points, place[:, 2] / sigma)


def choose(
    observations: Observations,
    among: np.ndarray,
    structure: Structure,
    poses: np.ndarray,
    offset: float,
    min_significance: float,
    gated: bool,
) -> np.ndarray:
    """Selects the observations (O,) bool to use of those in the mask `among`.

    Rejects landmarks whose inverse depth is less than `min_significance` standard deviations above zero, observations
    with the point behind the camera, observations beyond the 99.9 % quantile of chi-square (if `gated`), and finally
    landmarks that fewer than two keyframes observe.
    """
    far = ~(structure.significance >= min_significance)
    points = np.where(far[:, None], 0.0, structure.points)
    residuals, in_front = whitened_residuals(observations, poses, points, offset)
    kept = among & in_front & ~far[observations.landmark]
    if gated:
        kept &= np.sum(residuals**2, axis=1) <= CHI_SQUARE_999[np.where(observations.stereo, 3, 2)]
    return seen_again(observations, kept)


def seen_again(observations: Observations, kept: np.ndarray) -> np.ndarray:
    """The `kept` observations (O,) of landmarks that two keyframes or more observe."""
    pairs = np.unique(np.column_stack([observations.landmark, observations.keyframe])[kept], axis=0)
    views = np.bincount(pairs[:, 0], minlength=len(observations.host))
    return np.asarray(kept & (views[observations.landmark] >= 2))


def _first_guess(observations: Observations, offset: float) -> np.ndarray:
    """(u, v, disparity) of each landmark in its host; a missing disparity is the mean of the other views', or 1 px."""
    stereo, landmark, count = observations.stereo, observations.landmark, len(observations.host)
    place = observations.measurement[observations.host].copy()
    views = np.bincount(landmark[stereo], minlength=count)
    total = np.bincount(landmark[stereo], observations.measurement[stereo, 2], minlength=count)
    mean = np.where(views > 0, total / np.maximum(views, 1), offset + 1.0)
    place[:, 2] = np.where(stereo[observations.host], place[:, 2], mean) - offset
    return place


def _rays(intrinsics: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Rays (L, 3) of unit depth through pixels (L, 2 or more)."""
    fx, fy, cx, cy, _ = intrinsics
    return np.column_stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))])


def _in_camera(observations: Observations, poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (O, 3) in the cameras' frames, and whether they are in front; points behind are set to (0, 0, 1)."""
    T = se3_inverse(poses)[observations.keyframe]
    seen = np.einsum("oij,oj->oi", T[:, :3, :3], points[observations.landmark]) + T[:, :3, 3]
    in_front = seen[:, 2] > 0
    seen[~in_front] = [0, 0, 1]
    return seen, in_front


def _project(intrinsics: np.ndarray, seen: np.ndarray, scale: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """(u, v, disparity) of points (O, 3) multiplied by `scale`, and the derivative (O, 3, 3) by the points."""
    fx, fy, cx, cy, baseline = intrinsics
    X, Y, Z = seen.T
    disparity = fx * baseline * scale / Z
    predicted = np.column_stack([fx * X / Z + cx, fy * Y / Z + cy, disparity])
    jacobian = np.zeros((len(seen), 3, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = fx / Z, fy / Z
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -fx * X / Z**2, -fy * Y / Z**2
    jacobian[:, 2, 2] = -disparity / Z
    return predicted, jacobian


def _sum_by_landmark(observations: Observations, values: np.ndarray) -> np.ndarray:
    """Sums (L, ...) of values (O, ...)."""
    flat = values.reshape(len(values), -1)
    count = len(observations.host)
    sums = np.stack([np.bincount(observations.landmark, column, count) for column in flat.T], axis=1)
    return sums.reshape(count, *values.shape[1:])


def _is_regular(information: np.ndarray) -> np.ndarray:
    """Whether matrices (L, 3, 3) can be inverted, independent of the units."""
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    positive = (diagonal > 0).all(axis=1) & np.isfinite(information).all(axis=(1, 2))
    scale = np.sqrt(np.where(positive[:, None], diagonal, 1.0))
    correlation = np.where(positive[:, None, None], information, np.eye(3)) / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(positive & (np.linalg.eigvalsh(correlation)[:, 0] > 1e-10))


def _upper_root(information: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.cholesky(information).transpose(0, 2, 1))


def _apply(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("oij,oj->oi", matrices, vectors)

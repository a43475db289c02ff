"""The map: stereo landmarks of retired keyframes, refined by every view that saw them again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.camera import RectifiedStereo


@dataclass(frozen=True, slots=True)
class PointMap:
    """Sparse map.

    Attributes:
        points: (M, 3) float64 in the world, metres.
        covariances: (M, 3, 3) metres squared, relative to the keyframe that saw the point first.
        observations: (M,) views that confirmed it.
    """

    points: np.ndarray
    covariances: np.ndarray
    observations: np.ndarray


class KeyframeLandmarks:
    """The landmarks of one keyframe as a batch of three-state information filters in (u, v, disparity).

    The tracker measures against the first estimate, whose noise is independent of the pose; what accumulates here is
    for the map, where each re-observation sharpens the depth (9.3).

    Args:
        index: (K,) which of the keyframe's features they are.
        measured: (K, 3) (u, v, disparity).
        sigma: (K, 3) standard deviations.
    """

    def __init__(self, index: np.ndarray, measured: np.ndarray, sigma: np.ndarray) -> None:
        self.index = index
        self.measured = measured
        self.sigma = sigma
        self.observations = np.ones(len(index), np.int64)
        self._information = np.eye(3) / (sigma * sigma)[:, None, :]
        self._weighted = np.einsum("kij,kj->ki", self._information, measured)

    def observe(
        self,
        rows: np.ndarray,
        measurement: np.ndarray,
        noise: np.ndarray,
        T_key_camera: np.ndarray,
        camera: RectifiedStereo,
        offset: float,
    ) -> None:
        """Adds the views of landmarks `rows` (M,) by a camera at T_key_camera.

        Args:
            rows: (M,) positions in this batch, each once.
            measurement: (M, 3) (u, v, disparity), all known.
            noise: (M, 3, 3).
            T_key_camera: (4, 4).
            camera: the rectified pair.
            offset: disparity offset, pixels.
        """
        # The point as the current view measures it, carried back into the keyframe with its covariance.
        back, jacobian = _transfer(measurement, T_key_camera, camera, offset)
        carried = jacobian @ noise @ jacobian.transpose(0, 2, 1)
        usable = np.isfinite(carried).all(axis=(1, 2)) & np.isfinite(back).all(axis=1)
        usable &= np.linalg.eigvalsh(np.where(usable[:, None, None], carried, np.eye(3)))[:, 0] > 0
        information = np.linalg.inv(carried[usable])
        rows = rows[usable]
        self._information[rows] += information
        self._weighted[rows] += np.einsum("kij,kj->ki", information, back[usable])
        self.observations[rows] += 1

    def to_map(
        self, T_world_key: np.ndarray, camera: RectifiedStereo, offset: float, least_observations: int
    ) -> PointMap:
        """Landmarks that were seen often enough and are closer than half a pixel of disparity says, in the world."""
        refined = np.linalg.solve(self._information, self._weighted[..., None])[..., 0]
        refined[:, 2] -= offset
        kept = (self.observations >= least_observations) & (refined[:, 2] > 0.5)
        refined, covariance = refined[kept], np.linalg.inv(self._information[kept])
        points = camera.triangulate(refined)
        jacobian = _triangulation_jacobian(refined, points, camera)
        R = T_world_key[:3, :3]
        spread = R @ jacobian @ covariance @ jacobian.transpose(0, 2, 1) @ R.T
        return PointMap(points @ R.T + T_world_key[:3, 3], spread, self.observations[kept])


def merge_maps(parts: list[PointMap]) -> PointMap:
    """All points of all parts."""
    if not parts:
        return PointMap(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    return PointMap(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.observations for part in parts]),
    )


def _triangulation_jacobian(uvd: np.ndarray, points: np.ndarray, camera: RectifiedStereo) -> np.ndarray:
    """Derivative of (9.34) by (u, v, disparity), (K, 3, 3): the chapter's (9.35)."""
    depth, disparity = points[:, 2], uvd[:, 2]
    jacobian = np.zeros((len(uvd), 3, 3))
    jacobian[:, 0, 0] = depth / camera.fx
    jacobian[:, 1, 1] = depth / camera.fy
    jacobian[:, :, 2] = -points / disparity[:, None]
    return jacobian


def _transfer(
    uvd: np.ndarray, T_to_from: np.ndarray, camera: RectifiedStereo, offset: float
) -> tuple[np.ndarray, np.ndarray]:
    """Stereo points seen from another pose, and the derivative, by finite steps of a thousandth of a pixel."""

    def carry(values: np.ndarray) -> np.ndarray:
        inverse_depth = (values[:, 2:] - offset) / (camera.fx * camera.baseline)
        ray = np.c_[
            (values[:, 0] - camera.cx) / camera.fx, (values[:, 1] - camera.cy) / camera.fy, np.ones(len(values))
        ]
        seen = ray @ T_to_from[:3, :3].T + inverse_depth * T_to_from[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = np.where(seen[:, 2:] > 0, seen, np.nan)  # behind: the caller leaves it out
            return np.c_[
                camera.fx * seen[:, 0] / seen[:, 2] + camera.cx,
                camera.fy * seen[:, 1] / seen[:, 2] + camera.cy,
                camera.fx * camera.baseline * inverse_depth[:, 0] / seen[:, 2] + offset,
            ]

    step = 1e-3
    columns = [(carry(uvd + step * axis) - carry(uvd - step * axis)) / (2 * step) for axis in np.eye(3)]
    return carry(uvd), np.stack(columns, axis=-1)

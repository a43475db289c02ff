"""The unscented pose filter at run time: numpy state around the exported graphs (or their torch twins)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.rotation import se3_adjoint, se3_inverse
from sigmaslam.session import OnnxGraph, shipped_weights

# Order of the error state; see sigmaslam.filters.stereo_pose, which defines it (a test compares them).
POSE, TWIST, CALIBRATION, CLONE = slice(0, 6), slice(6, 12), slice(12, 13), slice(13, 19)
STATE_SIZE = 19

_Step = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]


@dataclass(frozen=True, slots=True)
class PoseState:
    """Mean and covariance of the filter.

    Attributes:
        pose, clone: (4, 4) T_world_camera now and at the keyframe.
        twist: (6,) velocity of the camera in its own frame, m/s and rad/s.
        offset: (1,) disparity offset, pixels.
        covariance: (19, 19) in the order pose, twist, calibration, clone; poses perturbed from the left.
    """

    pose: np.ndarray
    clone: np.ndarray
    twist: np.ndarray
    offset: np.ndarray
    covariance: np.ndarray

    @property
    def offset_variance(self) -> float:
        """Variance of the disparity offset, pixels squared."""
        return max(float(self.covariance[CALIBRATION, CALIBRATION].item()), 0.0)

    def body_covariance(self, origin: np.ndarray) -> np.ndarray:
        """(6, 6) covariance of the pose in the camera's frame, translation first.

        Args:
            origin: (6, 6) covariance of where the filter's certainty began, as `PoseFilter.forget_origin` returns it.
        """
        return _to_body(self.pose, self.covariance[POSE, POSE] + origin)

    def relative_covariance(self) -> np.ndarray:
        """(6, 6) covariance of the pose relative to the keyframe, in the camera's frame, translation first."""
        P = self.covariance
        cross = P[POSE, CLONE]
        return _to_body(self.pose, P[POSE, POSE] + P[CLONE, CLONE] - cross - cross.T)


@dataclass(frozen=True, slots=True)
class StereoPoints:
    """Landmarks of the keyframe with where they are seen now.

    Attributes:
        landmarks: (M, 3) (u, v, disparity) in the keyframe.
        landmark_sigma: (M, 3) their standard deviations.
        measurement: (M, 3) (u, v, disparity) now; the disparity may be NaN.
        noise: (M, 3, 3) covariance of the measurement.
    """

    landmarks: np.ndarray
    landmark_sigma: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray

    def select(self, index: np.ndarray) -> StereoPoints:
        """The points of that index or mask."""
        return StereoPoints(
            self.landmarks[index], self.landmark_sigma[index], self.measurement[index], self.noise[index]
        )


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """What an update did.

    Attributes:
        nis: normalised innovation squared.
        dof: its degrees of freedom, the number of scalar measurements.
        squared_residual: (M,) whitened residuals after the update.
        components: (M,) measurements that each point had, 2 or 3.
    """

    nis: float
    dof: int
    squared_residual: np.ndarray
    components: np.ndarray


class PoseFilter:
    """Predicts, updates and clones; owns the state.

    Args:
        camera: the rectified pair.
        offset_sigma: prior of the disparity offset, pixels.
        backend: "onnx" or "torch".
    """

    def __init__(self, camera: RectifiedStereo, offset_sigma: float, backend: str = "onnx") -> None:
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.fx * camera.baseline])
        self._predict, self._innovate, self._update = (
            _load(name, backend) for name in ("pose_predict", "pose_innovate", "pose_update")
        )
        covariance = np.zeros((STATE_SIZE, STATE_SIZE))
        covariance[CALIBRATION, CALIBRATION] = offset_sigma**2
        self.state = PoseState(np.eye(4), np.eye(4), np.zeros(6), np.zeros(1), covariance)

    def set_twist(self, twist: np.ndarray, sigma: np.ndarray) -> None:
        """Replaces the velocity by one that is independent of everything else; sigma (6,) m/s and rad/s."""
        P = self.state.covariance.copy()
        P[TWIST, :] = 0.0
        P[:, TWIST] = 0.0
        P[TWIST, TWIST] = np.diag(sigma**2)
        self.state = replace(self.state, twist=twist, covariance=P)

    def set_pose_from_clone(self, T_key_camera: np.ndarray, sigma: np.ndarray) -> None:
        """Replaces the pose by one that is known relative to the keyframe; sigma (6,) in the camera's frame."""
        pose = self.state.clone @ T_key_camera
        adjoint = se3_adjoint(pose)
        P = self.state.covariance.copy()
        P[POSE, :] = P[CLONE, :]
        P[:, POSE] = P[:, CLONE]
        P[POSE, POSE] = P[CLONE, CLONE] + adjoint @ np.diag(sigma**2) @ adjoint.T
        self.state = replace(self.state, pose=pose, covariance=P)

    def forget_origin(self) -> np.ndarray:
        """Takes the current pose for certain and returns the covariance that it had, (6, 6), in the world.

        For a new start from a pose that is hardly known: perturbations from the left that are common to pose and clone
        cancel in what the images see, but exactly so only while they are small.
        """
        P = self.state.covariance.copy()
        lost = P[POSE, POSE].copy()
        for block in (POSE, CLONE):
            P[block, :] = 0.0
            P[:, block] = 0.0
        self.state = replace(self.state, covariance=P)
        return lost

    def clone_pose(self) -> None:
        """Makes the current pose the keyframe's."""
        P = self.state.covariance.copy()
        P[CLONE, :] = P[POSE, :]
        P[:, CLONE] = P[:, POSE]
        P[CLONE, CLONE] = self.state.covariance[POSE, POSE]
        self.state = replace(self.state, clone=self.state.pose, covariance=P)

    def hold_offset(self, offset: np.ndarray, variance: float) -> None:
        """Replaces what is known of the disparity offset by something independent of the rest."""
        P = self.state.covariance.copy()
        P[CALIBRATION, :] = 0.0
        P[:, CALIBRATION] = 0.0
        P[CALIBRATION, CALIBRATION] = variance
        self.state = replace(self.state, offset=offset, covariance=P)

    def predict(self, step: float, densities: np.ndarray) -> None:
        """Moves the state on by `step` seconds; densities (3,) as in sigmaslam.filters.stereo_pose.Predict."""
        state = self.state
        pose, covariance = self._predict(
            {
                "pose": state.pose,
                "twist": state.twist,
                "covariance": state.covariance,
                "step": np.array(step),
                "densities": densities,
            }
        )
        self.state = replace(state, pose=pose, covariance=_symmetric(covariance))

    def innovate(
        self, landmarks: np.ndarray, landmark_sigma: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predicted (u, v, disparity) (M, 3), innovation covariance (M, 3, 3) and whether in front (M,) bool."""
        state = self.state
        predicted, covariance, in_front = self._innovate(
            {
                "pose": state.pose,
                "clone": state.clone,
                "offset": state.offset,
                "covariance": state.covariance,
                "intrinsics": self._intrinsics,
                "landmarks": landmarks,
                "landmark_sigma": landmark_sigma,
                "noise": noise,
            }
        )
        return predicted, covariance, in_front > 0.5

    def evaluate_update(self, points: StereoPoints) -> tuple[PoseState, UpdateResult]:
        """Posterior without taking it over, so that the caller can gate and ask again."""
        state = self.state
        known = np.isfinite(points.measurement)
        new_pose, new_clone, new_twist, new_offset, covariance, nis, _, squared_residual = self._update(
            {
                "pose": state.pose,
                "clone": state.clone,
                "twist": state.twist,
                "offset": state.offset,
                "covariance": state.covariance,
                "intrinsics": self._intrinsics,
                "landmarks": points.landmarks,
                "landmark_sigma": points.landmark_sigma,
                "measurement": np.where(known, points.measurement, 0.0),
                "noise": points.noise,
                "weight": known.astype(np.float64),
            }
        )
        posterior = PoseState(new_pose, new_clone, new_twist, new_offset, _symmetric(covariance))
        return posterior, UpdateResult(float(nis), int(known.sum()), squared_residual, known.sum(axis=1))


def _load(name: str, backend: str) -> _Step:
    if backend == "torch":
        from sigmaslam.models.torch_runtime import filter_module

        return filter_module(name)
    return OnnxGraph(shipped_weights(f"{name}.onnx"))


def _to_body(pose: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    adjoint = se3_adjoint(se3_inverse(pose))
    return _symmetric(adjoint @ covariance @ adjoint.T)


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (matrix + matrix.T))

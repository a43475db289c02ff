"""Views of landmarks, linearised about poses and a calibration by sigma points or derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.calibration_errors import measured_errors
from sigmaslam.estimation.state_layout import (
    CALIBRATION,
    CALIBRATION_MODELLED,
    LANDMARK_SIZE,
    MODELLED,
    pose_slice,
)
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_adjoint, se3_inverse
from sigmaslam.inference.onnx_graph import load_step

# Least spread of sigma points: share of the scene's depth, radians, pixels; with it alone slopes are derivatives.
_MIN_SPREAD = 1e-6
# Largest standard deviation that sigma points are drawn from: share of the scene's depth and radians.
_MAX_SPREAD = 0.05


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Measurements of landmarks by views, linearised.

    Attributes:
        mean: (M, 3) expected (u, v, disparity).
        by_state, by_landmark: (M, 3, n), (M, 3, 6) derivatives.
        nonlinearity: (M, 3, 3) covariance of what is not linear.
        in_front: (M,) bool, the landmark is in front of the camera.
    """

    mean: np.ndarray
    by_state: np.ndarray
    by_landmark: np.ndarray
    nonlinearity: np.ndarray
    in_front: np.ndarray


class ViewLineariser:
    """Linearises views of landmarks of one keyframe by another pose; the measurement model is a graph.

    Args:
        camera: the rectified pair.
        backend: "onnx" or "torch".
        unscented: by sigma points; else by first derivatives.
    """

    def __init__(self, camera: RectifiedStereo, backend: str, unscented: bool) -> None:
        self._camera = camera
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline])
        self._transfer = load_step("stereo_transfer", backend)
        self._unscented = unscented

    def linearise(
        self,
        poses: np.ndarray,
        calibration: np.ndarray,
        covariance: np.ndarray,
        landmarks: np.ndarray,
        landmark_covariance: np.ndarray,
        anchor: np.ndarray,
        view: np.ndarray,
        common: np.ndarray,
        depth: float,
    ) -> Linearisation:
        """Linearises M views.

        Args:
            poses: (K, 4, 4) T_world_camera.
            calibration: (12,) its errors.
            covariance: (n, n) of calibration and poses, which sigma points are drawn from.
            landmarks, landmark_covariance: (M, 6), (M, 6, 6) in their anchor keyframes.
            anchor, view: (M,) which of the poses a landmark is anchored to, and which sees it.
            common: (M, 3, 2) how shared errors of place enter.
            depth: of the scene, metres.
        """
        count, size = len(poses), len(covariance)
        if not len(landmarks):  # the graph takes no empty batch
            square = np.zeros((0, 3, 3))
            return Linearisation(
                square[:, 0], np.zeros((0, 3, size)), np.zeros((0, 3, LANDMARK_SIZE)), square, np.zeros(0, bool)
            )
        pairs, pair = np.unique(anchor * count + view, return_inverse=True)
        anchors, sights = pairs // count, pairs % count
        relative = se3_inverse(poses[sights]) @ poses[anchors]
        adjoint = se3_adjoint(se3_inverse(poses[sights]))
        chain = np.zeros((len(pairs), 9, size))
        for k, (from_, to) in enumerate(zip(anchors, sights, strict=True)):
            chain[k, :6, pose_slice(from_)] = adjoint[k]
            chain[k, :6, pose_slice(to)] -= adjoint[k]
        chain[:, 6:, :CALIBRATION_MODELLED] = np.eye(CALIBRATION_MODELLED)
        floor = np.diag(np.r_[np.full(3, depth), np.ones(6)] * _MIN_SPREAD) ** 2
        joint = chain @ covariance @ chain.transpose(0, 2, 1) if self._unscented else np.zeros((len(pairs), 9, 9))
        spread = np.linalg.cholesky(_limited(0.5 * (joint + joint.transpose(0, 2, 1)), depth) + floor)
        own = landmark_covariance[:, :MODELLED, :MODELLED] * float(self._unscented)
        landmark_spread = np.linalg.cholesky(own + _MIN_SPREAD**2 * np.eye(MODELLED))
        mean, slopes, nonlinearity, in_front = self._transfer(
            {
                "relative": relative,
                "spread": spread,
                "pair": pair,
                "calibration": calibration[:CALIBRATION_MODELLED],
                "intrinsics": self._intrinsics,
                "landmarks": landmarks[:, :MODELLED],
                "landmark_spread": landmark_spread,
            }
        )
        by_state = slopes[:, :, :9] @ (np.linalg.inv(spread) @ chain)[pair]
        by_landmark = np.concatenate([slopes[:, :, 9:] @ np.linalg.inv(landmark_spread), common], axis=2)
        # A pair that is off sees each point as the calibrated pair sees another one, in the anchor and in the view.
        in_anchor, in_view = (measured_errors(self._camera, uvd) for uvd in (landmarks[:, :3], mean))
        by_error = (in_view - by_landmark[:, :, :3] @ in_anchor)[:, :, CALIBRATION_MODELLED:]
        by_state[:, :, CALIBRATION_MODELLED : CALIBRATION.stop] = by_error
        mean = mean + by_error @ calibration[CALIBRATION_MODELLED:]
        mean = mean + (common @ landmarks[:, MODELLED:, None])[..., 0]
        return Linearisation(mean, by_state, by_landmark, nonlinearity, in_front > 0.5)


def _limited(covariance: np.ndarray, depth: float) -> np.ndarray:
    """Covariances (k, 9, 9) of relative poses and calibration, shrunk where sigma points would leave the scene."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    worst = np.maximum(variance[:, :3].max(axis=1) / depth**2, variance[:, 3:6].max(axis=1))
    return covariance * np.minimum(1.0, _MAX_SPREAD**2 / np.maximum(worst, 1e-300))[:, None, None]

"""Pose of a stereo camera from points of a keyframe: the chapter's system (9.37)-(9.42) made consistent.

State (error coordinates in this order, see `Layout`):
  pose        6  T_world_camera, left perturbation Exp(xi) T: translation, rotation
  twist       6  constant velocity of the camera in its own frame, m/s and rad/s
  calibration 1  disparity offset in pixels (measured minus true)
  clone       6  T_world_keyframe, left perturbation like the pose
The first twelve are (9.37); the clone makes the relative pose, which is all that the images see, exactly invariant to
where the trajectory has drifted, and the offset is what a wrong rectification needs (without it the filter is sure of
a wrong scale). More clones and calibration terms append to the layout.

A landmark is (u, v, disparity) in the keyframe: its inverse depth enters linearly, so far points and points at infinity
do no harm. Its covariance is carried into the current view and added to the measurement noise.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sigmaslam.filters.lie import adjoint_se3, exp_se3, invert_se3, log_se3
from sigmaslam.filters.linalg import cholesky
from sigmaslam.filters.unscented import covariance_of, iterated_update, odd_and_even, sigma_offsets

POSE = slice(0, 6)
TWIST = slice(6, 12)
CALIBRATION = slice(12, 13)
CLONE = slice(13, 19)
STATE_SIZE = 19

# A point whose depth along the current optical axis is below this share of its depth in the keyframe is not used: it
# is behind the camera, or about to be.
# Powers of two are exact in float32, through which the exporter takes scalars.
_NEAREST = 0.0625
UPDATE_ITERATIONS = 2


class Predict(nn.Module):
    """Constant-velocity prediction over a real time step.

    Shapes:
        pose, clone (4, 4), twist (6,), offset (1,), covariance (19, 19), step () seconds, densities (3,): power
        spectral densities of the accelerations, translation (m^2/s^3) and rotation (rad^2/s^3), and of the offset's
        random walk (px^2/s) -> predicted pose (4, 4) and covariance (19, 19); all float64.
    """

    def forward(
        self, pose: Tensor, twist: Tensor, covariance: Tensor, step: Tensor, densities: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Sigma points through T Exp(twist dt); noise is added after, the points are drawn anew by the update."""
        offsets = sigma_offsets(cholesky(covariance))
        predicted = pose @ exp_se3(twist * step)
        moved = exp_se3(offsets[:, POSE]) @ pose @ exp_se3((twist + offsets[:, TWIST]) * step)
        error = log_se3(moved @ invert_se3(predicted))
        mean, spread = covariance_of(torch.cat([error, offsets[:, 6:]], dim=-1))
        return exp_se3(mean[POSE]) @ predicted, spread + _process_noise(predicted, step, densities)


class Innovate(nn.Module):
    """Predicted measurements and their innovation covariances, point by point.

    Shapes: as `Update`; -> predicted (m, 3), innovation covariance (m, 3, 3), in_front (m,) 1.0 or 0.0.
    """

    def forward(
        self,
        pose: Tensor,
        clone: Tensor,
        offset: Tensor,
        covariance: Tensor,
        intrinsics: Tensor,
        landmarks: Tensor,
        landmark_covariance: Tensor,
        noise: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The measurement's unscented transform (steps 4 and 5 of Table 9.2)."""
        offsets = sigma_offsets(cholesky(covariance))
        samples, _ = _measure(offsets, pose, clone, offset, intrinsics, landmarks)
        mean, odd, even = odd_and_even(samples)
        centre, depth = _measure(torch.zeros_like(offsets[:1]), pose, clone, offset, intrinsics, landmarks)
        total = _effective_noise(pose, clone, offset, intrinsics, landmarks, landmark_covariance, noise)
        total = total + odd @ odd.transpose(-1, -2) + even @ even.transpose(-1, -2)
        return mean, total, (depth[0] > _NEAREST).to(mean.dtype)


class Update(nn.Module):
    """Iterated unscented update by stereo points of the keyframe.

    Shapes:
        pose, clone (4, 4), twist (6,), offset (1,), covariance (19, 19), intrinsics (5,) = (fx, fy, cx, cy, fx
        baseline), landmarks (m, 3) = (u, v, disparity) in the keyframe, landmark_covariance (m, 3, 3), measurement
        (m, 3), noise (m, 3, 3), weight (m, 3): 1 for a component that takes part, 0 for one that does not
        -> pose, clone, twist, offset, covariance, nis (), log-likelihood (), squared whitened residuals after the
        update (m,); all float64.
    """

    def forward(
        self,
        pose: Tensor,
        clone: Tensor,
        twist: Tensor,
        offset: Tensor,
        covariance: Tensor,
        intrinsics: Tensor,
        landmarks: Tensor,
        landmark_covariance: Tensor,
        measurement: Tensor,
        noise: Tensor,
        weight: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Posterior of the state; the covariance is carried into the chart at the new mean."""
        factor = cholesky(covariance)
        total = _effective_noise(pose, clone, offset, intrinsics, landmarks, landmark_covariance, noise)
        whitener = _whitener(total, weight)

        def measure(whitened: Tensor) -> Tensor:
            tangent = whitened @ factor.transpose(0, 1)
            return _measure(tangent, pose, clone, offset, intrinsics, landmarks)[0]

        result = iterated_update(measure, measurement, whitener, STATE_SIZE, UPDATE_ITERATIONS)
        correction = factor @ result.mean
        new_pose = exp_se3(correction[POSE]) @ pose
        new_clone = exp_se3(correction[CLONE]) @ clone
        # The posterior lives in the chart at the prior mean: its sigma points, seen from the new mean, carry it over.
        tangent = correction + sigma_offsets(factor @ cholesky(result.covariance))
        error_pose = log_se3(exp_se3(tangent[:, POSE]) @ pose @ invert_se3(new_pose))
        error_clone = log_se3(exp_se3(tangent[:, CLONE]) @ clone @ invert_se3(new_clone))
        rest = tangent[:, 6:13] - correction[6:13]
        _, posterior = covariance_of(torch.cat([error_pose, rest, error_clone], dim=-1))
        new_offset = offset + correction[CALIBRATION]
        after, _ = _measure(torch.zeros_like(tangent[:1]), new_pose, new_clone, new_offset, intrinsics, landmarks)
        residual = (whitener @ (measurement - after[0]).unsqueeze(-1)).squeeze(-1)
        return (
            new_pose,
            new_clone,
            twist + correction[TWIST],
            new_offset,
            posterior,
            result.nis,
            result.log_likelihood,
            (residual * residual).sum(dim=-1),
        )


def _measure(
    tangent: Tensor, pose: Tensor, clone: Tensor, offset: Tensor, intrinsics: Tensor, landmarks: Tensor
) -> tuple[Tensor, Tensor]:
    """(u, v, disparity) (k, m, 3) of the landmarks for k tangent offsets (k, 19), and relative depths (k, m).

    (9.39)-(9.42) with the right eye's column written as disparity, in inverse depth: the point at (u, v) in the
    keyframe is the ray r, and R r + t / z is what the current camera sees of it.
    """
    relative = invert_se3(exp_se3(tangent[:, POSE]) @ pose) @ exp_se3(tangent[:, CLONE]) @ clone
    fx, fy, cx, cy, focal_baseline = (intrinsics[i] for i in range(5))
    bias = (offset + tangent[:, CALIBRATION]).unsqueeze(-1)
    ray = torch.stack(
        [(landmarks[:, 0] - cx) / fx, (landmarks[:, 1] - cy) / fy, torch.ones_like(landmarks[:, 0])], dim=-1
    )
    inverse_depth = (landmarks[:, 2].unsqueeze(0).unsqueeze(-1) - bias) / focal_baseline
    turned = ray @ relative[:, :3, :3].transpose(1, 2)
    seen = turned + inverse_depth * relative[:, :3, 3].unsqueeze(1)
    depth = seen[..., 2]
    divisor = depth.clamp_min(0.5 * _NEAREST)
    predicted = torch.stack(
        [
            fx * seen[..., 0] / divisor + cx,
            fy * seen[..., 1] / divisor + cy,
            focal_baseline * inverse_depth.squeeze(-1) / divisor + bias.squeeze(-1),
        ],
        dim=-1,
    )
    return predicted, depth


def _effective_noise(
    pose: Tensor,
    clone: Tensor,
    offset: Tensor,
    intrinsics: Tensor,
    landmarks: Tensor,
    landmark_covariance: Tensor,
    noise: Tensor,
) -> Tensor:
    """Measurement noise plus the landmark's covariance seen in the current view, (m, 3, 3)."""
    relative = invert_se3(pose) @ clone
    fx, fy, cx, cy, focal_baseline = (intrinsics[i] for i in range(5))
    ray = torch.stack(
        [(landmarks[:, 0] - cx) / fx, (landmarks[:, 1] - cy) / fy, torch.ones_like(landmarks[:, 0])], dim=-1
    )
    R, t = relative[:3, :3], relative[:3, 3]
    inverse_depth = (landmarks[:, 2:] - offset) / focal_baseline
    seen = ray @ R.transpose(0, 1) + inverse_depth * t
    depth = seen[:, 2:].clamp_min(0.5 * _NEAREST)
    # Columns: derivatives of the seen point by u, v and disparity of the landmark.
    d_seen = torch.stack(
        [(R[:, 0] / fx).expand_as(seen), (R[:, 1] / fy).expand_as(seen), (t / focal_baseline).expand_as(seen)], dim=-1
    )
    d_depth = d_seen[:, 2:, :]
    ratio = seen[:, :2] / depth
    d_image = (d_seen[:, :2, :] - ratio.unsqueeze(-1) * d_depth) / depth.unsqueeze(-1)
    focal = torch.stack([fx, fy]).unsqueeze(-1)
    last = torch.tensor([0.0, 0.0, 1.0], dtype=pose.dtype, device=pose.device)
    d_disparity = (last - focal_baseline * inverse_depth / depth * d_depth.squeeze(1)) / depth
    jacobian = torch.cat([focal * d_image, d_disparity.unsqueeze(1)], dim=1)
    return noise + jacobian @ landmark_covariance @ jacobian.transpose(1, 2)


def _whitener(covariance: Tensor, weight: Tensor) -> Tensor:
    """Inverse Cholesky factor (m, 3, 3) of each point's noise, with zero rows for the components that are left out."""
    present = weight.unsqueeze(-1) * weight.unsqueeze(-2)
    identity = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    masked = covariance * present + identity * (1.0 - weight).unsqueeze(-1)
    a, b, c = masked[:, 0, 0], masked[:, 1, 0], masked[:, 2, 0]
    l00 = torch.sqrt(a)
    l10, l20 = b / l00, c / l00
    l11 = torch.sqrt(masked[:, 1, 1] - l10 * l10)
    l21 = (masked[:, 2, 1] - l20 * l10) / l11
    l22 = torch.sqrt(masked[:, 2, 2] - l20 * l20 - l21 * l21)
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    zero = torch.zeros_like(i00)
    inverse = torch.stack([i00, zero, zero, i10, i11, zero, i20, i21, i22], dim=-1).unflatten(-1, (3, 3))
    return inverse * weight.unsqueeze(-1)


def _process_noise(pose: Tensor, step: Tensor, densities: Tensor) -> Tensor:
    """White acceleration over one step, (19, 19): the exact integral, turned from the body frame into the world's."""
    identity = torch.eye(6, dtype=pose.dtype, device=pose.device)
    six = torch.cat([densities[0].expand(3), densities[1].expand(3)])
    adjoint = adjoint_se3(pose)
    body = identity * six
    pose_pose = adjoint @ (body * (step * step * step / 3.0)) @ adjoint.transpose(0, 1)
    pose_twist = adjoint @ (body * (0.5 * step * step))
    twist_twist = body * step
    walk = (densities[2] * step).reshape(1, 1)
    zero_column = torch.zeros(6, 7, dtype=pose.dtype, device=pose.device)
    return torch.cat(
        [
            torch.cat([pose_pose, pose_twist, zero_column], dim=1),
            torch.cat([pose_twist.transpose(0, 1), twist_twist, zero_column], dim=1),
            torch.cat([zero_column[:1, :6], zero_column[:1, :6], walk, zero_column[:1, :6]], dim=1),
            torch.zeros(6, STATE_SIZE, dtype=pose.dtype, device=pose.device),
        ],
        dim=0,
    )

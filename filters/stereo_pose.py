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
do no harm. Its covariance is carried into the current view and added to the measurement noise, at every sigma point
anew: the residual is whitened by the noise that belongs to the pose it is computed for, which makes its square the
likelihood maximised over the landmarks. With the noise of one fixed pose the landmarks would act as regressors without
error, and where depths hardly differ, the translation comes out short and the disparity offset wrong (attenuation).
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
        landmark_sigma: Tensor,
        noise: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The measurement's unscented transform (steps 4 and 5 of Table 9.2)."""
        offsets = sigma_offsets(cholesky(covariance))
        samples, _, _ = _measure(offsets, pose, clone, offset, intrinsics, landmarks)
        mean, odd, even = odd_and_even(samples)
        _, depth, jacobian = _measure(torch.zeros_like(offsets[:1]), pose, clone, offset, intrinsics, landmarks)
        xx, yx, yy, dx, dy, dd = (entry[0] for entry in _total_noise(noise, jacobian, landmark_sigma))
        total = torch.stack([xx, yx, dx, yx, yy, dy, dx, dy, dd], dim=-1).unflatten(-1, (3, 3))
        both = torch.cat([odd, even], dim=-1)
        spread = torch.stack([(both * both[:, i : i + 1]).sum(dim=-1) for i in range(3)], dim=-1)
        total = total + spread
        return mean, total, (depth[0] > _NEAREST).to(mean.dtype)


class Update(nn.Module):
    """Iterated unscented update by stereo points of the keyframe.

    Shapes:
        pose, clone (4, 4), twist (6,), offset (1,), covariance (19, 19), intrinsics (5,) = (fx, fy, cx, cy, fx
        baseline), landmarks (m, 3) = (u, v, disparity) in the keyframe, landmark_sigma (m, 3) their standard
        deviations, measurement (m, 3), noise (m, 3, 3), weight (m, 3): 1 for a component that takes part, else 0
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
        landmark_sigma: Tensor,
        measurement: Tensor,
        noise: Tensor,
        weight: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Posterior of the state; the covariance is carried into the chart at the new mean."""
        factor = cholesky(covariance)

        def residual(whitened: Tensor) -> Tensor:
            tangent = whitened @ factor.transpose(0, 1)
            predicted, _, jacobian = _measure(tangent, pose, clone, offset, intrinsics, landmarks)
            total = _total_noise(noise, jacobian, landmark_sigma)
            return _whiten(total, measurement - predicted, weight).flatten(1)

        result = iterated_update(residual, STATE_SIZE, UPDATE_ITERATIONS, pose)
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
        after = result.residual.unflatten(0, (-1, 3))
        # The noise differs between sigma points, so the NIS is taken at the posterior, where in a linear model it is
        # the same: what remains of the innovation and what the prior paid.
        nis = (result.mean * result.mean).sum() + (after * after).sum()
        return (
            new_pose,
            new_clone,
            twist + correction[TWIST],
            new_offset,
            posterior,
            nis,
            result.log_likelihood + 0.5 * (result.nis - nis),
            (after * after).sum(dim=-1),
        )


def _measure(
    tangent: Tensor, pose: Tensor, clone: Tensor, offset: Tensor, intrinsics: Tensor, landmarks: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """What k tangent offsets (k, 19) make of m landmarks.

    (9.39)-(9.42) with the right eye's column written as disparity, in inverse depth: the point at (u, v) in the
    keyframe is the ray r, and R r + t / z is what the current camera sees of it.

    Returns:
        (u, v, disparity) (k, m, 3); depths as a share of those in the keyframe (k, m); derivatives of the first by
        the landmark (k, m, 3, 3).
    """
    relative = invert_se3(exp_se3(tangent[:, POSE]) @ pose) @ exp_se3(tangent[:, CLONE]) @ clone
    R, t = relative[:, :3, :3], relative[:, :3, 3].unsqueeze(1)
    fx, fy, cx, cy, focal_baseline = (intrinsics[i] for i in range(5))
    bias = offset + tangent[:, CALIBRATION]
    ray = torch.stack(
        [(landmarks[:, 0] - cx) / fx, (landmarks[:, 1] - cy) / fy, torch.ones_like(landmarks[:, 0])], dim=-1
    )
    inverse_depth = (landmarks[:, 2] - bias) / focal_baseline
    seen = ray @ R.transpose(1, 2) + inverse_depth.unsqueeze(-1) * t
    depth = seen[..., 2]
    share = 1.0 / depth.clamp_min(0.5 * _NEAREST)
    ratio_u, ratio_v, ratio_d = seen[..., 0] * share, seen[..., 1] * share, inverse_depth * share
    predicted = torch.stack([fx * ratio_u + cx, fy * ratio_v + cy, focal_baseline * ratio_d + bias], dim=-1)
    # Columns: how the seen point moves with u, v and disparity of the landmark.
    moves = torch.stack([R[:, :, 0] / fx, R[:, :, 1] / fy, t[:, 0] / focal_baseline], dim=-1).unsqueeze(1)
    lift = torch.tensor([0.0, 0.0, 1.0], dtype=pose.dtype, device=pose.device)
    jacobian = torch.stack(
        [
            fx * (moves[..., 0, :] - ratio_u.unsqueeze(-1) * moves[..., 2, :]),
            fy * (moves[..., 1, :] - ratio_v.unsqueeze(-1) * moves[..., 2, :]),
            lift - focal_baseline * ratio_d.unsqueeze(-1) * moves[..., 2, :],
        ],
        dim=-2,
    ) * share.unsqueeze(-1).unsqueeze(-1)
    return predicted, depth, jacobian


# The six entries of the lower triangle of a symmetric (3, 3): uu, vu, vv, du, dv, dd. Kept apart, because elementwise
# arithmetic on (k, m) is many times faster than k m products of tiny matrices.
_Lower = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _total_noise(noise: Tensor, jacobian: Tensor, landmark_sigma: Tensor) -> _Lower:
    """Measurement noise (m, 3, 3) plus the landmarks' own, seen through k views (k, m, 3, 3); entries (k, m)."""
    scaled = jacobian * landmark_sigma.unsqueeze(-2)
    u, v, d = scaled[..., 0, :], scaled[..., 1, :], scaled[..., 2, :]
    return (
        noise[:, 0, 0] + (u * u).sum(dim=-1),
        noise[:, 1, 0] + (v * u).sum(dim=-1),
        noise[:, 1, 1] + (v * v).sum(dim=-1),
        noise[:, 2, 0] + (d * u).sum(dim=-1),
        noise[:, 2, 1] + (d * v).sum(dim=-1),
        noise[:, 2, 2] + (d * d).sum(dim=-1),
    )


def _whiten(covariance: _Lower, residual: Tensor, weight: Tensor) -> Tensor:
    """Residuals (k, m, 3) over the Cholesky factor of their covariance; zero where the weight (m, 3) is."""
    uu, vu, vv, du, dv, dd = covariance
    w0, w1, w2 = weight[:, 0], weight[:, 1], weight[:, 2]
    # A component that is left out gets unit variance and no covariance with the others.
    l00 = torch.sqrt(uu * w0 + (1.0 - w0))
    l10 = vu * (w0 * w1) / l00
    l20 = du * (w0 * w2) / l00
    l11 = torch.sqrt(vv * w1 + (1.0 - w1) - l10 * l10)
    l21 = (dv * (w1 * w2) - l20 * l10) / l11
    l22 = torch.sqrt(dd * w2 + (1.0 - w2) - l20 * l20 - l21 * l21)
    first = residual[..., 0] * w0 / l00
    second = (residual[..., 1] * w1 - l10 * first) / l11
    third = (residual[..., 2] * w2 - l20 * first - l21 * second) / l22
    return torch.stack([first, second, third], dim=-1)


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

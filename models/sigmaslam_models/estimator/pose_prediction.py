"""Constant velocity on SE(3): the chapter's twelve states (9.37), predicted over a real time step.

State (error coordinates in this order):
  pose   6  T_reference_camera, left perturbation Exp(xi) T: translation, rotation
  twist  6  constant velocity of the camera in its own frame, m/s and rad/s
"""

from functools import partial

import torch
from torch import Tensor, nn

from sigmaslam_filters.core.plain_factors import cholesky
from sigmaslam_filters.core.sigma_points import cubature
from sigmaslam_filters.core.transforms import Unscented
from sigmaslam_filters.graphs.exact_operators import ExactOperators
from sigmaslam_filters.manifolds.se3_matrices import adjoint_se3, exp_se3, invert_se3, log_se3

POSE = slice(0, 6)
TWIST = slice(6, 12)
STATE_SIZE = 12


class Predict(nn.Module):
    """Unscented prediction over a real time step.

    Shapes:
        pose (4, 4), twist (6,), covariance (12, 12), step () seconds, densities (2,): power spectral densities of the
        accelerations, translation (m^2/s^3) and rotation (rad^2/s^3) -> predicted pose (4, 4) and covariance (12, 12);
        all float64. The covariance may be singular: a fresh reference is known exactly.
    """

    def forward(
        self, pose: Tensor, twist: Tensor, covariance: Tensor, step: Tensor, densities: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Sigma points through T Exp(twist dt); noise is added after."""
        predicted = pose @ exp_se3(twist * step)
        moved = partial(moved_state, pose, twist, step, invert_se3(predicted))
        with ExactOperators():
            state = Unscented(cubature())(moved, cholesky(covariance)[0], None)
            mean, spread = state.mean, state.columns.covariance()
        return exp_se3(mean[POSE]) @ predicted, spread + process_noise(predicted, step, densities)


def moved_state(pose: Tensor, twist: Tensor, step: Tensor, back: Tensor, offsets: Tensor) -> Tensor:
    """Offsets (K, 12) after the step, from a pose whose inverse (4, 4) is `back`."""
    after = exp_se3(offsets[:, POSE]) @ pose @ exp_se3((twist + offsets[:, TWIST]) * step)
    return torch.cat([log_se3(after @ back), offsets[:, TWIST]], dim=-1)


def process_noise(pose: Tensor, step: Tensor, densities: Tensor) -> Tensor:
    """White acceleration over one step, (12, 12): the exact integral, turned from the body frame into the reference."""
    six = torch.cat([densities[0].expand(3), densities[1].expand(3)])
    body = torch.eye(6, dtype=pose.dtype, device=pose.device) * six
    adjoint = adjoint_se3(pose)
    pose_pose = adjoint @ (body * (step * step * step / 3.0)) @ adjoint.transpose(0, 1)
    pose_twist = adjoint @ (body * (0.5 * step * step))
    return torch.cat(
        [torch.cat([pose_pose, pose_twist], dim=1), torch.cat([pose_twist.transpose(0, 1), body * step], dim=1)]
    )

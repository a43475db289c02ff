"""Prediction by an inertial sensor: sigma points of all that it measures by.

State (error coordinates in this order):
  pose      6  T_keyframe_camera, left perturbation Exp(xi) T: translation, rotation
  velocity  3  of the sensor, in the keyframe's frame, m/s
  gravity   3  in the keyframe's frame, m/s^2
  biases    6  gyro, rad/s; accelerometer, m/s^2
  delay     1  error of the shift between the clocks, s
  factors  18  errors of scale and misalignment: matrices on rate, and on force, row by row
  mounting  6  T_camera_imu, left perturbation
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sigmaslam_filters.core.sigma_points import cubature
from sigmaslam_filters.graphs.exact_operators import ExactOperators
from sigmaslam_filters.manifolds.se3_matrices import exp_se3, invert_se3, log_se3, skew

POSE, VELOCITY, GRAVITY = slice(0, 6), slice(6, 9), slice(9, 12)
BIASES_TO_FACTORS, MOUNTING = slice(12, 37), slice(37, 43)
STATE_SIZE = 43


class InertialPredict(nn.Module):
    """Unscented prediction through a preintegrated motion (Forster et al. 2017, eqs. 26, 37 and 44).

    Shapes:
        pose (4, 4), velocity (3,), gravity (3,), mounting (4, 4), root (43, 43) of the covariance, seconds (); turn
        (3, 3), velocity_change (3,), position_change (3,), slope (9, 25), noise (9, 9) as of
        `sigmaslam.estimation.preintegration`; walk (2,) power spectra of the biases' random walks -> predicted pose
        (4, 4), velocity (3,), covariance (43, 43), and covariance (43, 43) of the state before with the one after; all
        float64. The root may be singular: a graph takes 3 ms for one of its own.
    """

    def forward(
        self,
        pose: Tensor,
        velocity: Tensor,
        gravity: Tensor,
        mounting: Tensor,
        root: Tensor,
        seconds: Tensor,
        turn: Tensor,
        velocity_change: Tensor,
        position_change: Tensor,
        slope: Tensor,
        noise: Tensor,
        walk: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Sigma points through the motion; noise is added after."""
        motion = pose, velocity, gravity, mounting, seconds, turn, velocity_change, position_change, slope
        # One evaluation of all points, the centre last: a graph spends its time on operators, not on their rows.
        with ExactOperators():
            points = cubature().offsets(root, with_centre=True)
            camera, v, body = moved_by_sensor(motion, points)
            predicted, speed = camera[-1], v[-1]
            local = torch.cat([log_se3(camera @ invert_se3(predicted)), v - speed, points[:, 9:]], dim=-1)[:-1]
            mean = cubature().mean(local, STATE_SIZE, with_centre=False)
            columns = cubature().deviations(local, mean, STATE_SIZE, with_centre=False)
            spread, carried = columns.covariance(), root @ columns.odd.transpose(0, 1)
        added = sensor_noise((pose @ mounting)[:3, :3], body[-1], noise, walk * seconds)
        return exp_se3(mean[POSE]) @ predicted, speed + mean[VELOCITY], spread + added, carried


def moved_by_sensor(motion: Sequence[Tensor], points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where states with offsets (K, 43) end by what all have in common, the module's arguments but for root and noises.

    Poses (K, 4, 4), velocities (K, 3), and poses of the sensor.
    """
    pose, velocity, gravity, mounting, seconds, turn, velocity_change, position_change, slope = motion
    change = points[:, BIASES_TO_FACTORS] @ slope.transpose(0, 1)
    turned = torch.cat([torch.zeros_like(change[:, :3]), change[:, :3]], dim=-1)
    offset, mount, turned = exp_se3(torch.stack([points[:, POSE], points[:, MOUNTING], turned]))
    mount = mount @ mounting
    body = offset @ pose @ mount
    R, p = body[:, :3, :3], body[:, :3, 3]
    v, g = velocity + points[:, VELOCITY], gravity + points[:, GRAVITY]
    gained = (R @ (velocity_change + change[:, 3:6]).unsqueeze(-1)).squeeze(-1)
    moved = (R @ (position_change + change[:, 6:]).unsqueeze(-1)).squeeze(-1)
    place = p + v * seconds + g * (seconds * seconds * 0.5) + moved
    top = torch.cat([R @ turn @ turned[:, :3, :3], place.unsqueeze(-1)], dim=-1)
    body = torch.cat([top, body[:, 3:]], dim=-2)
    return body @ invert_se3(mount), v + g * seconds + gained, body


def sensor_noise(R: Tensor, body: Tensor, noise: Tensor, walk: Tensor) -> Tensor:
    """(43, 43) of noise in the sensor's frames: turns from the right at the end, the others at the start."""
    zero = torch.zeros_like(R)
    turned = body[:3, :3]
    rows = torch.cat(
        [
            torch.cat([skew(body[:3, 3]) @ turned, zero, R], dim=1),
            torch.cat([turned, zero, zero], dim=1),
            torch.cat([zero, R, zero], dim=1),
        ]
    )
    nine = rows @ noise @ rows.transpose(0, 1)
    identity = torch.eye(STATE_SIZE, dtype=R.dtype, device=R.device)
    biases = torch.cat([walk[:1].expand(3), walk[1:].expand(3)])
    return identity[:, :9] @ nine @ identity[:9] + identity[:, 12:18] @ (biases[:, None] * identity[12:18])
